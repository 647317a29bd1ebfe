"""The commands run as a user calls them; their output and pictures are checked."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.__main__ import _METHODS, main
from fdof_jax.search.methods import METHODS


def pictures(folder):
    files = folder.glob("*.png")
    return sorted(path.name for path in files if path.stat().st_size > 5000)


def second_turn(printed):
    """Returns the rms tip errors before and after tuning [mm]."""
    (line,) = (row for row in printed.splitlines() if "in the second turn" in row)
    before, _, after = line.split()[-3:]
    return float(before), float(after)


def test_the_circle_is_the_default(tmp_path, capsys):
    main(["--output", str(tmp_path)])
    assert pictures(tmp_path) == [
        "circle-arm.png",
        "circle-efforts-paper.png",
        "circle-efforts-tuned.png",
        "circle-error.png",
        "circle-motion-paper.png",
        "circle-motion-tuned.png",
        "circle-path.png",
    ]
    printed = capsys.readouterr().out
    paper, tuned = second_turn(printed)
    assert paper == pytest.approx(253.5, abs=0.1) and tuned < 70
    assert "gains are at a bound" in printed
    assert "/: circle-arm.png, circle-arm.gif, circle-motion-paper.png" in printed
    assert (tmp_path / "circle-arm.gif").stat().st_size > 50_000
    assert f"{fj.load(tmp_path / 'tuned.json')}" in printed


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


@pytest.mark.slow
def test_tuning_of_an_ensemble(tmp_path, capsys):
    circle = "--radius 0.5 --period 1 --factor 3 --max-steps 2"
    # As in test_ensembles.py, whose program it shares.
    payload, others = "--payload 0 1", "--link-error 0.1 --start-offset 0.3 --speed 1 2"
    ensemble = f"--over worst --members 3 {payload} {others}"
    folder = ["--output", str(tmp_path)]
    main(["tune", *folder, *circle.split(), *ensemble.split()])
    assert "over 3 members" in capsys.readouterr().out
    assert "circle-path.png" in pictures(tmp_path)
    tuned = fj.load(tmp_path / "tuned.json")
    task = tuned.scene.forces[0].reference
    assert (task.radius, task.period, tuned.scene.t1) == (0.5, 1, 2)
    assert tuned.settings["over"] == "worst" and len(tuned.member_loss) == 3
    assert len(tuned.history.loss) <= 3
    np.testing.assert_allclose(tuned.upper, 9 * tuned.lower)


def test_a_price_of_effort_is_in_the_loss(tmp_path, monkeypatch):
    losses = []

    def tune(scene, *, loss, **keywords):
        losses.append(loss)
        raise ValueError("known by now")

    monkeypatch.setattr("fdof_jax.shell.commands.tune", tune)
    with pytest.raises(SystemExit):
        main(["tune", "--output", str(tmp_path), "--price", "0.01"])
    (loss,) = losses
    assert isinstance(loss, fj.tuning.Tracking) and loss.effort == 0.01


# Calls that need no JAX: the arguments, the exit status and part of the message.
AT_ONCE = [
    ("--version", 0, fj.__version__),
    ("--help", 0, "--output"),
    ("figures --help", 0, "--output"),
    ("tune --help", 0, "-4 2 by default"),
    ("square", 2, "invalid choice: 'square'"),
    ("--output", 2, "expected one argument"),
    ("--output file", 2, "--output: cannot write into 'file': File exists"),
    ("--output s3://a/b", 2, "--output: expected a folder on this machine, got 's3:"),
    ("figures --output file/in/it", 2, "cannot write into 'file/in/it': Not a dir"),
    ("tune --center 0", 2, "--center: expected 2 arguments"),
    ("tune --radius one", 2, "--radius: invalid float value: 'one'"),
    ("tune --starts 1.5", 2, "--starts: invalid int value: '1.5'"),
    ("tune --radius -1", 2, "--radius: expected a number of at least 0, got '-1'"),
    ("tune --price nan", 2, "--price: expected a number of at least 0, got 'nan'"),
    ("tune --factor 1", 2, "--factor: expected a number above 1, got '1'"),
    ("tune --speed 0 1", 2, "--speed: expected a number above 0, got '0'"),
    ("tune --members 0", 2, "--members: expected a number of at least 1, got '0'"),
    ("tune --starts 0", 2, "--starts: expected a number of at least 1, got '0'"),
    ("tune --seed -1", 2, "--seed: expected a number of at least 0, got '-1'"),
    ("tune --method newton", 2, "--method: invalid choice: 'newton'"),
]
if os.geteuid() != 0:  # root may write everywhere
    AT_ONCE += [
        ("--output sealed", 2, "cannot write into 'sealed': Permission denied"),
        ("--output sealed/in/it", 2, "write into 'sealed/in/it': Permission denied"),
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


def test_the_methods_are_the_library_s():
    assert list(METHODS) == _METHODS


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--center -1 2", "expected a circle within the linkage's reach"),
        ("--center 0 inf", "center: expected an array of 2 real numbers, all finite"),
        ("--period 0", "period: expected not zero"),
        ("--link-error 1", "link_error: expected less than 1"),
        ("--payload 2 1", "payload: expected the least before the greatest"),
        ("--over worst", "over: expected an ensemble to take the worst of"),
    ],
)
def test_the_library_refuses_options(options, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["tune", "--output", str(tmp_path), *options.split()])
    assert stop.value.code == 2 and message in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_league(tmp_path, capsys):
    main(["league", "--output", str(tmp_path)])
    table = capsys.readouterr().out.split("\n\n")[-2].splitlines()[2:]
    names = [row.split()[0] for row in table]
    errors = [float(row.split()[2]) for row in table]
    assert sorted(names) == sorted(fj.TOPOLOGIES) and errors == sorted(errors)
    assert errors[0] < 5 and errors[-1] < 60
    together = fj.load(tmp_path / "league.json")
    assert [*together] == [*fj.TOPOLOGIES]
    # One program tunes all, each as it is tuned alone.
    alone = fj.tune(fj.tuning.circle_scenes()["PPR"])
    np.testing.assert_allclose(together["PPR"].gains, alone.gains, rtol=1e-3)
    assert together["PPR"].loss == pytest.approx(alone.loss, rel=1e-4)
