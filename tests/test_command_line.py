"""The commands run as a user would call them, and write what they say."""

import numpy as np
import pytest

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
