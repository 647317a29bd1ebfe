"""The commands run as a user calls them: their pictures, answers and refusals."""

import os

import pytest
from PIL import Image

import fdof_jax as fj
from fdof_jax.__main__ import main

FIGURES = "fig3 fig4 fig5 fig6-angles fig6-energies fig7".split()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["figures", "topologies"])
def test_pictures_are_wide_enough_for_a_page(command, tmp_path, capsys):
    main([command, "--output", str(tmp_path)])
    names = FIGURES if command == "figures" else ["topologies"]
    assert sorted(path.stem for path in tmp_path.iterdir()) == names
    assert all(Image.open(path).width >= 1600 for path in tmp_path.glob("*.png"))
    files = [str(tmp_path / f"{name}.png") for name in names]
    *printed, last = capsys.readouterr().out.splitlines()
    if command == "figures":
        assert (printed, last) == (files, f"Open first: {files[0]} {files[-1]}")


# Calls that compute nothing: the arguments, the exit status and part of the message.
ANSWERS = [
    ("", None, "topologies"),
    ("--version", 0, fj.__version__),
    ("figures --help", 0, "--output"),
    ("square", 2, "invalid choice: 'square'"),
    ("--output", 2, "expected one argument"),
    ("figures --output file", 2, "--output: expected a folder that can be written "),
    ("figures --output file/in/it", 2, "(Not a directory), got 'file/in/it'."),
]
if os.geteuid() != 0:  # root may write everywhere
    ANSWERS.append(("topologies --output sealed", 2, "(Permission denied), got"))


@pytest.mark.parametrize(("arguments", "status", "message"), ANSWERS)
def test_answers(arguments, status, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "sealed").mkdir(mode=0o555)
    try:
        main(arguments.split())
        code = None
    except SystemExit as stop:
        code = stop.code
    printed = capsys.readouterr()
    assert code == status and message in printed.out + printed.err
    assert len([*tmp_path.iterdir()]) == 2
