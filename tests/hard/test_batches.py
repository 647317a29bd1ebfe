"""Scenes 2, 5 and 25: members of a batch that fail, or take long."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from elements import BAR
from modes import LOOPS

import fdof_jax as fj
from hard import scenes as hard
from hard.scenes import START, Breaking, arm

SIZE, HEAVY_TIP = 12, hard.load("heavy-tip-1e6")
NAN_START, NAN_LATER, MASSLESS, FAST, HEAVY = range(5)
OTHERS = slice(5, None)


@partial(jax.jit, **LOOPS)
@partial(jax.vmap, in_axes=(0, 0, 0, 0, None))
def motions(linkage, q, qd, at, ts):
    forces = (Breaking(at),)
    return fj.simulate(linkage, fj.State(q, qd), ts, forces, throw=False)


def test_members_that_fail_or_take_long_harm_no_other():
    """All members of a batch share one loop, which ends with the last member."""
    ts, rng = HEAVY_TIP.ts, np.random.default_rng(0)
    q, qd = START.q + rng.uniform(-0.3, 0.3, (SIZE, 3)), rng.uniform(-1, 1, (SIZE, 3))
    arms, at = jax.tree.map(lambda a: jnp.stack([a] * SIZE), arm()), np.full(SIZE, 1e9)
    clean = motions(arms, q, qd, at, ts)
    assert (clean.outcome == "successful").all()

    # Under a transformation no member's values can be checked beforehand.
    com, inertia = (a.at[MASSLESS, 2].set(0) for a in (arms.com, arms.inertia))
    changed = com, inertia, arms.mass.at[HEAVY, 2].set(1e6)
    arms = eqx.tree_at(lambda a: (a.com, a.inertia, a.mass), arms, changed)
    q[NAN_START, 1], at[NAN_LATER], qd[FAST] = np.nan, 0.32, [100, 0, 0]
    q[HEAVY], qd[HEAVY] = START
    mixed = motions(arms, q, qd, at, ts)
    failed = "not finite", "not finite", "ill-conditioned"
    assert mixed.outcome.tolist() == [*failed, *["successful"] * (SIZE - 3)]
    np.testing.assert_array_equal(mixed.q[OTHERS], clean.q[OTHERS])
    np.testing.assert_array_equal(mixed.qd[OTHERS], clean.qd[OTHERS])
    steps, reached = (mixed.stats[name] for name in ("num_steps", "time_reached"))
    # 46 bisections by 5 lead from a millisecond to the shortest step.
    assert max(steps[NAN_LATER], steps[MASSLESS]) < 120 and steps[NAN_START] < 200
    np.testing.assert_allclose(reached[:3], [0, 0.32, 0], atol=1e-9)
    before = ts < 0.32
    late = np.asarray(mixed.q[NAN_LATER])
    np.testing.assert_allclose(late[before], clean.q[NAN_LATER, before], atol=1e-9)
    assert np.isnan(late[~before]).all() and np.isnan(mixed.q[MASSLESS, 1:]).all()
    assert np.isnan(mixed.q[NAN_START]).any(axis=1).all()
    alone = hard.free(arm(), START.q, ts[:6])
    alone = hard.simulate(alone._replace(state0=fj.State(q[FAST], qd[FAST])))
    np.testing.assert_allclose(mixed.q[FAST, :6], alone.q, atol=1e-7)
    assert np.abs(mixed.q[HEAVY] - HEAVY_TIP.q).max() <= 1e-6
    assert steps[HEAVY] <= 5 * 2503
    accuracy = mixed.stats["accuracy"]
    assert accuracy[-1] < 1e-13 < 1e-9 < accuracy[HEAVY]


def test_a_member_that_starts_nan_adds_nothing_to_a_gradient():
    """A NaN of one member would make the sum over all members NaN."""

    @partial(jax.jit, **LOOPS)
    @jax.grad
    def slope(mass, q0):
        def end(q0):
            linkage = eqx.tree_at(lambda a: (a.mass, a.inertia), BAR, (mass, mass**2))
            start = fj.State(q0, np.zeros(1))
            motion = fj.simulate(linkage, start, [0, 0.5], throw=False)
            good = motion.result == diffrax.RESULTS.successful
            return jnp.where(good, jnp.sum(motion.q[-1]), 0.0)

        return jnp.sum(jax.vmap(end)(q0))

    q0, mass = np.array([[-0.5], [0.5]]), np.ones(1)
    first, second = (slope(mass, q0[[k, k]]) / 2 for k in (0, 1))
    spoilt = slope(mass, np.array([[-0.5], [np.nan]]))
    np.testing.assert_allclose(spoilt, first, rtol=1e-9)
    assert np.abs(first - second).max() > 1e-3
    np.testing.assert_allclose(slope(mass, q0), first + second, rtol=1e-8)
