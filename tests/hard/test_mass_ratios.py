"""Scenes 1, 2 and 4: no inertia, heavy tips and light tips."""

import numpy as np
import pytest

from hard import scenes as hard


def test_point_masses():
    """Without moments of inertia nothing keeps the mass matrix from being singular."""
    scene = hard.fig5(np.linspace(0, 10, hard.OUTPUTS))
    motion = hard.simulate(scene, hard.controller(1e-10))
    assert hard.error(motion, scene) <= 1e-6
    assert hard.drift(scene.linkage, motion.q, motion.qd) <= 1e-8


def test_gradients_of_point_masses():
    """Errors of the motion grow, and so do those of its derivatives."""
    exact = hard.REFERENCE["fig5"]
    _, *slopes = hard.slopes(hard.load("fig5"), hard.controller(1e-10))
    for name, slope in zip(("mass", "length"), slopes):
        assert np.isfinite(slope).all()
        assert hard.largest_error(slope, exact[f"dq_d{name}"]) <= 1e-5


@pytest.mark.parametrize(
    "name, tolerance, bound",
    [("1e3", 1e-12, 1e-8), pytest.param("1e6", 1e-10, 1e-5, marks=pytest.mark.slow)],
)
def test_heavy_tip(name, tolerance, bound):
    """The mass matrix, of condition 2e5 and 2e8, loses five and eight digits.

    With eight digits lost, steps of 1e-12 are short enough only by luck.
    """
    scene = hard.load(f"heavy-tip-{name}")
    assert hard.error(hard.simulate(scene, hard.controller(tolerance)), scene) <= bound


@pytest.mark.parametrize("name, bound", {"1e-6": 1e-6, "1e-9": 1e-8}.items())
def test_light_tip(name, bound):
    """One fast light body must not disturb two slow heavy ones."""
    scene = hard.load(f"light-tip-{name}")
    assert hard.error(hard.simulate(scene, hard.TIGHT), scene) <= bound


@pytest.mark.parametrize("name, bound", {"1e-6": 1.1e-5, "1e-9": 1.1e-8}.items())
def test_light_tip_leaves_a_two_link_chain(name, bound):
    """One fast light body must not disturb two slow heavy ones.

    Its own weight moves them by 1.082e-5 and 1.082e-8 rad, in computations with 60
    digits.
    """
    motion = hard.simulate(hard.load(f"light-tip-{name}"), hard.TIGHT)
    two_links = np.array(hard.REFERENCE["two-links"]["q"])
    assert np.abs(motion.q[:, :2] - two_links).max() <= bound
