"""Scene 10: links at 1000 rad/s."""

import pytest

from hard import scenes as hard


@pytest.mark.parametrize("name", ["hard-spin1e3", "spin"])
def test_fast_spins(name):
    """Coriolis terms of 1e6 cancel."""
    common = name.startswith("hard")
    scene = (hard.load_common if common else hard.load)(name)
    motion = hard.simulate(scene, hard.TIGHT)
    assert hard.error(motion, scene) <= 1e-6
    assert hard.drift(scene.linkage, motion.q, motion.qd) <= 1e-8
    assert motion.stats["num_steps"] <= 100_000


@pytest.mark.parametrize("tolerance, bound", [(1e-12, 1e-3), (1e-14, 1e-6)])
def test_a_fast_tip_on_slow_links(tolerance, bound):
    """The time scales of the links lie far apart, and errors grow 9.5e5 times.

    That is the derivative of q after 0.5 s in qd at the start, in computations with
    60 digits [s]. A tolerance of 1e-12 of 1000 rad/s therefore means an error of
    1e-3 rad. A tolerance of 1e-14 means 1e-5 rad, and each rounding of such a
    velocity 5e-8 rad. No program in float64 is sure to have an error below 1e-7.
    """
    scene = hard.load("spin-of-the-tip")
    motion = hard.simulate(scene, hard.controller(tolerance))
    assert hard.error(motion, scene) <= bound
    assert hard.drift(scene.linkage, motion.q, motion.qd) <= 1e-8
    assert motion.stats["num_steps"] <= 100_000
