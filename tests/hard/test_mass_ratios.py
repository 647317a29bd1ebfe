"""Scenes 1, 2 and 4: no inertia, heavy tips and light tips."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
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
    _, *slopes = hard.slopes(hard.load("fig5"))
    for name, slope in zip(("mass", "length"), slopes):
        assert np.isfinite(slope).all()
        assert hard.largest_error(slope, exact[f"dq_d{name}"]) <= 1e-5


@pytest.mark.parametrize(
    "name, bound, steps",
    [("1e3", 1e-8, 1130), ("1e6", 1e-6, 2503), ("1e9", 1e-3, 3837)],
)
def test_heavy_tip(name, bound, steps):
    """The mass matrix, of condition 2e5 to 2e11, loses five to eleven digits.

    `steps` are those of heyoka. Rounding errors of the rates exceed the tolerance by up
    to 1e7, and no step is short enough to meet it.
    """
    scene = hard.load(f"heavy-tip-{name}")
    motion = hard.simulate(scene, hard.TIGHT)
    assert hard.error(motion, scene) <= bound
    assert motion.stats["num_steps"] <= 5 * steps
    lost = float(name) * 2.0**-52
    assert lost < motion.stats["accuracy"] < 30 * lost


def test_heavy_tip_by_another_solver():
    scene = hard.load("heavy-tip-1e6")
    motion = hard.simulate(scene, hard.TIGHT, solver=diffrax.Dopri8())
    assert hard.error(motion, scene) <= 1e-6
    assert motion.stats["num_steps"] <= 100_000


def test_heavy_tips_in_a_batch_beside_a_healthy_arm():
    scene = hard.load("heavy-tip-1e6")
    arms = [scene.linkage.replace(mass=[1, 1, tip]) for tip in (1e6, 1)]
    stacked = jax.tree.map(lambda *a: np.stack(a), *arms)
    q, qd = (np.stack([a, a]) for a in scene.state0)
    both = hard.in_a_batch(stacked, q, qd, scene.ts)
    assert np.abs(both.q[0] - scene.q).max() <= 1e-6
    steps, accuracy = both.stats["num_steps"], both.stats["accuracy"]
    assert steps[1] < steps[0] <= 5 * 2503
    assert accuracy[1] < 1e-13 < 1e-9 < accuracy[0]


def test_derivatives_of_a_heavy_tip():
    """Over 0.1 s in which nothing grows, against differences over 1e-3 rad."""
    scene = hard.load("heavy-tip-1e6")

    @jax.jit
    @jax.value_and_grad
    def both(shift):
        start = fj.State(scene.state0.q + shift, scene.state0.qd)
        arm, ts = scene.linkage, jnp.array([0, 0.1])
        return fj.simulate(arm, start, ts, throw=False).q[-1, 0]

    _, slope = both(0.0)
    h = 1e-3
    difference = lambda h: (both(h)[0] - both(-h)[0]) / (2 * h)
    exact = (4 * difference(h / 2) - difference(h)) / 3
    np.testing.assert_allclose(slope, exact, rtol=1e-5)


@pytest.mark.parametrize(
    "name, bound, moved", [("1e-6", 1e-6, 1.1e-5), ("1e-9", 1e-8, 1.1e-8)]
)
def test_light_tip(name, bound, moved):
    """One fast light body must not disturb two slow heavy ones.

    Its own weight moves them by 1.082e-5 and 1.082e-8 rad, in computations with 60
    digits.
    """
    scene = hard.load(f"light-tip-{name}")
    motion = hard.simulate(scene, hard.TIGHT)
    assert hard.error(motion, scene) <= bound
    two_links = np.array(hard.REFERENCE["two-links"]["q"])
    assert np.abs(motion.q[:, :2] - two_links).max() <= moved
