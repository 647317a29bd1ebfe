"""Dry friction whose level depends on the direction and on the state."""

import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.forces import JointFriction

SLOPE = 0.3  # rad, of the block's slide
BLOCK = fj.Linkage(
    "P",
    length=[0, 1],
    com=[[0, 0]],
    mass=[1],
    inertia=[1],
    base_angle=SLOPE - np.pi / 2,
)
SLIDE = BLOCK.replace(gravity=0.0)


def test_a_block_comes_down_a_slope_by_the_friction_of_that_direction():
    """It goes up against 4 N, turns, and comes down against 1 N; rows are 4, 1."""
    v, (up, down) = 2.0, (4.0, 1.0)
    weight = 9.81 * np.sin(SLOPE)
    friction = (JointFriction([[up], [down]]),)
    ts = np.array([0.0, 0.1, 1.0])
    motion = fj.simulate(BLOCK, fj.State([0.0], [v]), ts, friction)
    top = v / (weight + up)
    height = v**2 / 2 / (weight + up)
    q = [0, v * 0.1 - (weight + up) * 0.1**2 / 2]
    q += [height - (weight - down) * (1 - top) ** 2 / 2]
    np.testing.assert_allclose(motion.q[:, 0], q, rtol=0, atol=1e-9)
    taken = [0, up * q[1], up * height + down * (height - q[2])]
    np.testing.assert_allclose(motion.taken, taken, rtol=0, atol=1e-9)
    effort = fj.joint_efforts(BLOCK, friction, motion).total[:, 0]
    np.testing.assert_allclose(effort, [-up, -up, down], rtol=0, atol=1e-12)
    # Held on the way down, and taken along by a push uphill of the same size.
    held = JointFriction([[1.0], [weight + 0.1]])
    assert fj.simulate(BLOCK, fj.State([0.0], [0.0]), ts, (held,)).q[-1, 0] == 0
    push = fj.JointEffort([2 * weight])
    motion = fj.simulate(BLOCK, fj.State([0.0], [0.0]), ts, (held, push))
    np.testing.assert_allclose(motion.q[-1, 0], (weight - 1) / 2, atol=1e-9)


def test_friction_in_one_direction_alone_lets_the_other_one_go():
    pull = lambda t, q, qd, linkage: jnp.maximum(t - 0.5, 0) * jnp.ones(1)
    free, held = JointFriction([[0.0], [3.0]]), JointFriction([[3.0], [0.0]])
    start, ts = fj.State([0.0], [0.0]), [0, 2.0]
    motion = fj.simulate(SLIDE, start, ts, (free, pull))
    np.testing.assert_allclose(motion.q[-1, 0], 1.5**3 / 6, rtol=0, atol=1e-9)
    assert fj.simulate(SLIDE, start, ts, (held, pull)).q[-1, 0] == 0


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: JointFriction(np.ones((3, 2))), "level: expected .*, or 2 such rows"),
        (lambda: JointFriction(1, static=np.ones((3, 2))), "static: expected .* rows"),
        (lambda: JointFriction([[1], [-1]]), "level: expected .* at least 0"),
        (lambda: JointFriction([[1], [2]], 1), "static: expected at least the level"),
        (
            lambda: fj.forces.elements_on(SLIDE, (JointFriction(np.ones((2, 3))),)),
            r"forces\[0\].level: expected numbers for 1 joints",
        ),
        (
            lambda: fj.to_mjcf(SLIDE, (JointFriction([[1], [2]]),)),
            r"forces\[0\]: expected one friction per joint, .* got JointFriction",
        ),
    ],
)
def test_malformed_levels_are_refused(make, words):
    with pytest.raises(ValueError, match=f"^{words}"):
        make()
