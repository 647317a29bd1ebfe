"""The commands run as a user would call them, and write what they say."""

import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import showcase
from fdof_jax.__main__ import main


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


@pytest.mark.parametrize("arguments", [["--help"], ["figures", "--help"]])
def test_help(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    assert "--output" in capsys.readouterr().out


def test_unknown_command(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["square"])
    assert stop.value.code == 2


def kept_gains(printed):
    """Tuned kp and kd of a printed table."""
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
    # The same members and bounds, from where the first run has come to.
    assert again.history.loss[0] == pytest.approx(earlier.loss, rel=1e-9)
    np.testing.assert_array_equal(again.upper, earlier.upper)
    # And the same search, but for the random starts.
    assert kept["search"] == saved["search"] | {"seed": 1}
    before, after = kept_gains(first), kept_gains(second)
    assert [row[1] for row in before] == [row[0] for row in after]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--resume", "x.fdof", "--radius", "1"], "--resume: the file says"),
        (["--resume", "x.fdof"], "x.fdof"),
        (["--payload", "0", "1"], "--over: mean or worst is needed for payload"),
        (["--radius", "-1"], "radius"),
        (["--price", "-1"], "price"),
        (["--factor", "0.5"], "factor"),
        (["--starts", "0"], "starts"),
        (["--save", "nowhere/x.fdof"], "--save: expected a file in a folder"),
        (["--method", "newton"], "--method"),
    ],
)
def test_tuning_refuses(options, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["tune", *options])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_league(capsys):
    main(["league"])
    table = capsys.readouterr().out.split("\n\n")[-1].splitlines()[2:]
    names = [row.split()[0] for row in table]
    errors = [float(row.split()[2]) for row in table]
    assert sorted(names) == sorted(fj.TOPOLOGIES) and errors == sorted(errors)
    assert errors[0] < 5 and errors[-1] < 60
