"""The commands run as a user calls them; their output and pictures are checked."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.__main__ import main
from fdof_jax.search import methods
from fdof_jax.shell import showcase
from fdof_jax.shell.tuning_run import METHODS


def pictures(folder):
    return sorted(path.name for path in folder.iterdir() if path.stat().st_size > 5000)


def test_the_circle_is_the_default(tmp_path, capsys):
    main(["--output", str(tmp_path)])
    assert pictures(tmp_path) == [
        "circle-efforts-paper.png",
        "circle-efforts-tuned.png",
        "circle-error.png",
        "circle-motion-paper.png",
        "circle-motion-tuned.png",
        "circle-path.png",
    ]
    printed = capsys.readouterr().out
    rms = next(line for line in printed.splitlines() if "second period: rms" in line)
    paper, tuned = map(float, rms.split()[-2:])
    assert paper == pytest.approx(253.5, abs=0.1) and tuned < 70
    assert "gains are at a bound" in printed


def test_figures(tmp_path, capsys):
    main(["figures", "--output", str(tmp_path)])
    assert pictures(tmp_path) == [
        "fig3.png",
        "fig4.png",
        "fig5.png",
        "fig6-angles.png",
        "fig6-energies.png",
        "fig7.png",
    ]
    assert str(tmp_path) in capsys.readouterr().out


def test_topologies(tmp_path):
    main(["--output", str(tmp_path), "topologies"])
    assert pictures(tmp_path) == ["topologies.png"]


def test_topologies_start_alike():
    from fdof_jax import to_chain

    chains = [
        to_chain(scene.linkage, *scene.state0)[0]
        for scene in showcase.topology_scenes().values()
    ]
    assert len(chains) == 7
    np.testing.assert_allclose(chains, np.tile(chains[0], (7, 1)), atol=1e-14)


def kept_gains(printed):
    """Returns the tuned kp and kd from a printed table."""
    lines = [
        line.split() for line in printed.splitlines() if line[:4] in ("kp o", "kd o")
    ]
    return [[float(cell) for cell in line[line.index(unit) + 1 :][:2]]
            for line in lines for unit in line if unit.endswith("]")]  # fmt: skip


@pytest.mark.slow
def test_tuning_goes_on_where_it_was_saved(tmp_path, capsys):
    file, folder = tmp_path / "run.fdof", ["--output", str(tmp_path)]
    circle = ["--radius", "0.5", "--period", "1", "--factor", "3"]
    ensemble = ["--over", "worst", "--members", "2", "--payload", "0", "1"]
    search = ["--max-steps", "2"]
    main(["tune", *folder, *circle, *ensemble, *search, "--save", str(file)])
    first = capsys.readouterr().out
    assert "before tuning: gradient against differences" in first
    assert "circle-path.png" in pictures(tmp_path)
    saved = fj.load(file)
    assert saved["job"].radius == 0.5 and saved["job"].over == "worst"
    main(["tune", *folder, *search, "--resume", str(file), "--save", str(file)])
    second = capsys.readouterr().out
    kept = fj.load(file)
    earlier, again = kept["results"]
    assert again.loss < earlier.loss
    np.testing.assert_array_equal(earlier.gains, saved["results"][0].gains)
    # The members and bounds are the same; the start is the first run's end.
    assert again.history.loss[0] == pytest.approx(earlier.loss, rel=1e-9)
    np.testing.assert_array_equal(again.upper, earlier.upper)
    # The search is the same, except for the random starts.
    assert kept["search"] == saved["search"] | {"seed": 1}
    before, after = kept_gains(first), kept_gains(second)
    assert [row[1] for row in before] == [row[0] for row in after]


# Calls that need no JAX: the arguments, the exit status and part of the message.
AT_ONCE = [
    ("--version", 0, fj.__version__),
    ("--help", 0, "--output"),
    ("figures --help", 0, "--output"),
    ("tune --help", 0, "-4.0 2.0 by default"),
    ("square", 2, "invalid choice: 'square'"),
    ("--output", 2, "expected one argument"),
    ("--output file", 2, "--output: cannot write into 'file': File exists"),
    ("figures --output file/in/it", 2, "cannot write into 'file/in/it': Not a dir"),
    ("tune --center 0 inf", 2, "--center: expected a finite number, got 'inf'"),
    ("tune --radius -1", 2, "--radius: expected a finite number of at least 0"),
    ("tune --period 0", 2, "--period: expected a finite number other than 0"),
    ("tune --price nan", 2, "--price: expected a finite number of at least 0"),
    ("tune --factor 1", 2, "--factor: expected a finite number above 1"),
    ("tune --speed 0 1", 2, "--speed: expected a finite number of at least 0.001"),
    ("tune --link-error 1", 2, "--link-error: expected a number from 0 to below 1"),
    ("tune --starts 0", 2, "--starts: expected a whole number of at least 1"),
    ("tune --seed 1.5", 2, "--seed: expected a whole number of at least 0, got '1.5'"),
    ("tune --method newton", 2, "--method: invalid choice: 'newton'"),
    ("tune --payload 0 1", 2, "--over: mean or worst is needed for payload"),
    ("tune --over mean --payload 2 1", 2, "--payload: expected the least before"),
    ("tune --save nowhere/x", 2, "--save: cannot write into 'nowhere': No such file"),
    ("tune --save file/x", 2, "--save: cannot write into 'file': Not a directory"),
    ("tune --save .", 2, "--save: expected a file, got the folder '.'"),
    ("tune --resume nothing", 2, "--resume: cannot read 'nothing': No such file"),
    ("tune --resume file", 2, "--resume: expected a file written by `fdof-jax tune"),
    ("tune --resume saved --radius 1", 2, "--resume: the file says what is tuned"),
]
if os.geteuid() != 0:  # root may write everywhere
    AT_ONCE += [
        ("--output sealed", 2, "cannot write into 'sealed': Permission denied"),
        ("--output sealed/in/it", 2, "write into 'sealed/in/it': Permission denied"),
        ("tune --save sealed/x", 2, "--save: cannot write into 'sealed': Permission"),
    ]
ANSWERS = """
import contextlib, io, json, sys
from fdof_jax.__main__ import main

def answer(arguments):
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main(arguments.split())
            status = None
        except SystemExit as stop:
            status = stop.code
    imported = [name for name in ("jax", "numpy") if name in sys.modules]
    return status, printed.getvalue(), imported

print(json.dumps({asked: answer(asked) for asked in json.loads(sys.argv[1])}))
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Returns the answers of one process; an import by one shows in all later ones."""
    folder = tmp_path_factory.mktemp("command_line")
    (folder / "file").write_text("not a folder")
    (folder / "sealed").mkdir(mode=0o555)
    fj.save(folder / "saved", {"of": "another kind"})
    asked = json.dumps([arguments for arguments, _, _ in AT_ONCE])
    run = subprocess.run(
        [sys.executable, "-c", ANSWERS, asked],
        cwd=folder, env=os.environ | {"COLUMNS": "200"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(run.stdout)


@pytest.mark.parametrize(("arguments", "status", "message"), AT_ONCE)
def test_answers_without_jax(arguments, status, message, answers):
    code, printed, imported = answers[arguments]
    assert code == status and message in printed and imported == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--center", "-1", "2"], "expected a circle within the linkage's reach"),
        (["--resume", "saved"], "saved: expected a file written by `fdof-jax tune"),
    ],
)
def test_refusals_that_need_jax(options, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fj.save("saved", {"of": "another kind"})
    with pytest.raises(SystemExit) as stop:
        main(["tune", *options])
    assert stop.value.code == 2 and message in capsys.readouterr().err


def test_methods_have_their_names():
    assert METHODS == tuple(methods.METHODS)


@pytest.mark.slow
def test_league(capsys):
    main(["league"])
    table = capsys.readouterr().out.split("\n\n")[-1].splitlines()[2:]
    names = [row.split()[0] for row in table]
    errors = [float(row.split()[2]) for row in table]
    assert sorted(names) == sorted(fj.TOPOLOGIES) and errors == sorted(errors)
    assert errors[0] < 5 and errors[-1] < 60
