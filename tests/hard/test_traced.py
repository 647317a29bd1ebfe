"""Scenes 5, 15 and 26 to 28: derivatives, and what no call can check as it is traced.

Scene 27 is junk in values that a topology does not use, as 0 x NaN is NaN.
"""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from hard import scenes as hard
from hard.scenes import START, arm

TS = np.linspace(0, 0.5, 21)


@eqx.filter_jit(**LOOPS)
def motion_and_slopes(linkage, q0, ts):
    """Returns a motion, the sum of q^2 at its end, and that sum's gradient.

    The gradient is that in the masses and in q0, by `jax.grad`.
    """

    def end(mass, q0):
        changed = eqx.tree_at(lambda a: a.mass, linkage, mass)
        start = fj.State(q0, START.qd)
        motion = fj.simulate(changed, start, ts, max_steps=2000, throw=False)
        return jnp.sum(motion.q[-1] ** 2), motion

    derive = jax.value_and_grad(end, (0, 1), has_aux=True)
    (value, motion), slopes = derive(linkage.mass, jnp.asarray(q0))
    return motion, value, slopes


def test_gradients_after_10_s_of_chaos():
    """They grow like errors, and so do their own errors."""
    scene, exact = hard.load("fig5"), hard.REFERENCE["fig5"]
    motion, _, slopes = motion_and_slopes(scene.linkage, scene.state0.q, scene.ts)
    for name, slope in zip(("mass", "q0"), slopes):
        columns = np.array(exact[f"dq_d{name}"])
        right = 2 * scene.q[-1] @ columns
        # The bound of the columns, in the sum.
        assert np.abs(slope - right).max() <= 1e-5 * np.abs(right).max()


def test_a_gradient_of_what_was_not_reached_is_zero_and_the_value_tells():
    """A derivative of NaN would spoil that of a sum that leaves failed members out."""
    outcome = diffrax.RESULTS.max_steps_reached
    motion, value, slopes = motion_and_slopes(arm(), START.q, 1000 * TS)
    assert np.isnan(value) and motion.result == outcome
    assert not any(np.any(slope) for slope in slopes)
    motion, *_ = motion_and_slopes(arm(mass=[1, 1, 1e12]), START.q, TS)
    assert motion.outcome == "ill-conditioned" and motion.stats["num_steps"] < 100


def unused(topology):
    """Returns the entries of a linkage that no acceleration depends on."""
    entries = {"length": [0, 3], "locked": [], "com": [], "inertia": []}
    if topology.startswith("R"):
        entries["locked"].append(0)  # where it stands, not how it moves
    # Links that only slide do not turn.
    for link in range(len(topology) - len(topology.lstrip("P"))):
        entries["com"].append(link)
        entries["inertia"].append(link)
    return {name: np.array(rows) for name, rows in entries.items() if rows}


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_parameters_that_a_topology_does_not_use(topology):
    """One program serves all topologies and selects unused values away.

    Selections multiply by 0 in derivatives. NaN spoils links that only slide, and the
    motion reports it.
    """
    linkage = arm(topology, locked=[0.2, 0.3, 0.4])
    clean, _, slopes = motion_and_slopes(linkage, START.q, TS)
    assert clean.outcome == "successful"
    assert all(np.isfinite(slope).all() for slope in slopes)
    for name, rows in unused(topology).items():
        for junk in (1e30, np.nan):
            values = getattr(linkage, name).at[rows].set(junk)
            spoilt = eqx.tree_at(lambda a, of=name: getattr(a, of), linkage, values)
            dirty, _, found = motion_and_slopes(spoilt, START.q, TS)
            if np.isnan(junk) and name in ("com", "inertia"):
                assert dirty.outcome == "not finite"
                continue
            for a, b in zip((dirty.q, *found), (clean.q, *slopes)):
                np.testing.assert_array_equal(a, b, err_msg=f"{name} {junk}")


@partial(jax.jit, **LOOPS)
def masked(linkage, x, xd, force):
    """Returns accelerations of the paper's form, and derivatives of a sum of them."""

    def accelerations(mass, x):
        changed = eqx.tree_at(lambda a: a.mass, linkage, mass)
        xdd = fj.paper.masked_accelerations(changed, x, xd, force)
        return jnp.arange(1.0, 7.0) @ xdd, xdd

    derive = jax.value_and_grad(accelerations, (0, 1), has_aux=True)
    (_, xdd), slopes = derive(linkage.mass, x)
    return xdd, *slopes


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_efforts_of_fictitious_joints(topology):
    """The paper's equations add them and subtract them again."""
    linkage = arm(topology, locked=0.2)
    chain = linkage, *fj.paper.to_chain(linkage, *START)
    fictitious = np.asarray(fj.existence_factors(topology)) == 0
    efforts = [np.where(fictitious, junk, np.arange(6)) for junk in (0, 1e30, np.nan)]
    clean, *dirty = (masked(*chain, effort) for effort in efforts)
    assert all(np.isfinite(leaf).all() for leaf in clean)
    for found in dirty:
        for a, b in zip(found, clean):
            np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="^force: expected .*finite"):
        fj.paper.masked_accelerations(*chain, efforts[-1])


@partial(jax.jit, **LOOPS)
@partial(jax.grad, argnums=(1, 2))
def slopes_of_everything(linkage, q, qd):
    everything = (
        fj.tip_position(linkage, q),
        fj.paper.to_chain(linkage, q, qd),
        fj.mass_centers(linkage, q),
        fj.energy(linkage, q, qd),
        fj.forward_dynamics(linkage, q, qd, np.zeros(3)),
        fj.analysis.inertia_ratios(linkage, q),
    )
    # NaN in the slope of any of them is NaN in that of the sum.
    return sum(map(jnp.sum, jax.tree.leaves(everything)))


@pytest.mark.filterwarnings("ignore:prismatic joints .* are parallel")
@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_derivatives_where_everything_is_zero(topology):
    """The arm is straight along the x axis, at rest: atan2, roots and norms of 0."""
    slopes = slopes_of_everything(arm(topology), np.zeros(3), np.zeros(3))
    assert all(np.isfinite(slope).all() for slope in slopes)
