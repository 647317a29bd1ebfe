"""Scenes 25 and 26: members of a batch that fail, and solves out of steps.

Members that fail in a sweep are tested in tests/test_sweep.py, with their gradients.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from hard.scenes import OUTPUTS, SIZE, START, Breaking, arm, behind_the_door, in_a_batch

TS = np.linspace(0, 0.5, OUTPUTS)
STILL = np.zeros(1)
NAN_START, NAN_LATER, FAST = 17, 101, 200
BAD = np.array([NAN_START, NAN_LATER, FAST])
OTHERS = np.delete(np.arange(SIZE), BAD)


def batch(bad):
    """Returns positions, velocities and times at which efforts break."""
    rng = np.random.default_rng(0)
    q = START.q + rng.uniform(-0.3, 0.3, (SIZE, 3))
    qd = rng.uniform(-1, 1, (SIZE, 3))
    at = np.full(SIZE, 1e9)
    if bad:
        q[NAN_START, 1], at[NAN_LATER], qd[FAST] = np.nan, 0.32, [100, 0, 0]
    return q, qd, at


def motions(q, qd, at):
    return in_a_batch(jax.tree.map(lambda a: a[None], arm()), q, qd, TS, at)


def test_members_that_fail_harm_no_other():
    """All members of a batch share one loop, which ends with the last member."""
    clean, mixed = motions(*batch(False)), motions(*batch(True))
    assert (clean.outcome == "successful").all()
    expected = np.full(SIZE, "successful")
    expected[[NAN_START, NAN_LATER]] = "not finite"
    np.testing.assert_array_equal(mixed.outcome, expected)
    for a, b in ((mixed.q, clean.q), (mixed.qd, clean.qd)):
        np.testing.assert_array_equal(np.asarray(a)[OTHERS], np.asarray(b)[OTHERS])
    assert np.isnan(mixed.q[NAN_START]).any(axis=1).all()
    # No step ends at 0.32 s itself.
    before = TS < 0.32
    np.testing.assert_allclose(
        mixed.q[NAN_LATER, before], clean.q[NAN_LATER, before], atol=1e-9
    )
    assert np.isnan(mixed.q[NAN_LATER, ~before]).all()
    reached = mixed.stats["time_reached"][BAD[:2]]
    np.testing.assert_allclose(reached, [0, 0.32], atol=1e-9)
    # 46 bisections by 5 lead from a millisecond to the shortest step.
    assert (mixed.stats["num_steps"][BAD[:2]] < 120).all()
    alone = fj.simulate(arm(), fj.State(*(a[FAST] for a in batch(True)[:2])), TS)
    np.testing.assert_allclose(mixed.q[FAST], alone.q, atol=1e-7)


def test_a_member_that_starts_nan_adds_nothing_under_vmap():
    """A NaN of one member would make the sum over all members NaN."""
    # Of one link, whose program is the smallest.
    one = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])

    def loss(mass, q0):
        def end(q0):
            linkage = eqx.tree_at(lambda a: (a.mass, a.inertia), one, (mass, mass**2))
            motion = fj.simulate(linkage, fj.State(q0, STILL), TS, throw=False)
            good = motion.result == diffrax.RESULTS.successful
            return jnp.where(good, jnp.sum(motion.q[-1]), 0.0)

        return jnp.sum(jax.vmap(end)(q0))

    slope = jax.jit(jax.grad(loss), **LOOPS)
    q0, mass = np.array([[-0.5], [0.5]]), np.ones(1)
    # Two of them: the same program.
    first, second = (slope(mass, q0[[k, k]]) / 2 for k in (0, 1))
    spoilt = slope(mass, np.where([[False], [True]], np.nan, q0))
    np.testing.assert_allclose(spoilt, first, rtol=1e-9)
    # Without such a member the gradient is the sum of both.
    assert np.abs(first - second).max() > 1e-3
    together = slope(mass, q0)
    np.testing.assert_allclose(together, first + second, rtol=1e-8)


@pytest.mark.parametrize("solver", [None, diffrax.Dopri8()])
def test_a_controller_of_one_s_own_does_not_reject_for_ever(solver):
    """diffrax's shortest step is 0, so it would reject NaN until no steps are left."""
    steps = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    motion = fj.simulate(
        arm(), START, TS, (Breaking(0.32),), solver=solver, throw=False,
        stepsize_controller=steps,
    )  # fmt: skip
    assert motion.outcome == "not finite"
    assert motion.stats["num_steps"] < 200


LONG = np.linspace(0, 5, 26)


def test_running_out_of_steps_is_told():
    """The state that was reached looks like any other."""
    solution = fj.simulate(arm(), START, LONG, max_steps=50, throw=False)
    assert solution.outcome == "out of steps"
    reached = solution.stats["time_reached"]
    assert 0 < reached < LONG[-1]
    finite = np.isfinite(solution.q).all(axis=1) & np.isfinite(solution.qd).all(axis=1)
    np.testing.assert_array_equal(finite, LONG <= reached)
    exact = fj.simulate(arm(), START, LONG)
    np.testing.assert_allclose(solution.q[finite], exact.q[finite], atol=1e-8)
    with pytest.raises(RuntimeError, match="max_steps|maximum number of solver steps"):
        fj.simulate(arm(), START, LONG, max_steps=50)


def test_a_gradient_of_what_was_not_reached_is_zero_and_the_value_tells():
    """An output filled with NaN has a derivative of 0, which looks like an optimum.

    A derivative of NaN would spoil the derivative of a sum that leaves failed
    members out. The value and the outcome report the failure instead.
    """

    motion, value, slopes = behind_the_door(arm(), START.q, np.linspace(0, 20, OUTPUTS))
    assert np.isnan(value) and motion.result == diffrax.RESULTS.max_steps_reached
    assert not any(np.any(slope) for slope in slopes)
