"""The commands run as a user calls them: their pictures, answers and refusals."""

import os

import pytest
from PIL import Image

import fdof_jax as fj
from fdof_jax.__main__ import main


def pictures(folder):
    """Returns the names of pictures that are wide enough for a page."""
    files = folder.glob("*.png")
    return sorted(path.name for path in files if Image.open(path).width >= 1600)


@pytest.mark.slow
def test_figures(tmp_path, capsys):
    main(["figures", "--output", str(tmp_path)])
    figures = "fig3 fig4 fig5 fig6-angles fig6-energies fig7".split()
    names = [f"{figure}.png" for figure in figures]
    assert pictures(tmp_path) == names
    *printed, last = capsys.readouterr().out.splitlines()
    assert printed == [str(tmp_path / name) for name in names]
    first = [str(tmp_path / name) for name in ("fig3.png", "fig7.png")]
    assert last == " ".join(["Open first:", *first])


@pytest.mark.slow
def test_topologies(tmp_path):
    main(["--output", str(tmp_path), "topologies"])
    assert pictures(tmp_path) == ["topologies.png"]


def test_without_a_command_the_help_is_printed(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main([])
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("figures", "topologies", "--output"))
    assert not [*tmp_path.iterdir()]


# Calls that compute nothing: the arguments, the exit status and part of the message.
ANSWERS = [
    ("--version", 0, fj.__version__),
    ("--help", 0, "--output"),
    ("figures --help", 0, "--output"),
    ("square", 2, "invalid choice: 'square'"),
    ("--output", 2, "expected one argument"),
    ("figures --output file", 2, "--output: expected a folder that can be written "),
    ("figures --output file", 2, "(File exists), got 'file'."),
    ("figures --output file/in/it", 2, "(Not a directory), got 'file/in/it'."),
]
if os.geteuid() != 0:  # root may write everywhere
    ANSWERS += [
        ("topologies --output sealed", 2, "(Permission denied), got 'sealed'."),
        ("topologies --output sealed/in", 2, "(Permission denied), got 'sealed/in'."),
    ]


@pytest.mark.parametrize(("arguments", "status", "message"), ANSWERS)
def test_answers(arguments, status, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "sealed").mkdir(mode=0o555)
    with pytest.raises(SystemExit) as stop:
        main(arguments.split())
    printed = capsys.readouterr()
    assert stop.value.code == status and message in printed.out + printed.err
