"""Gradients of random motions through switches, all topologies, by differences."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import pytest
from modes import LOOPS
from switching_scenes import ELEMENTS, random_members, random_scene

import fdof_jax as fj


@pytest.mark.slow
def test_gradients_equal_differences():
    """Derivatives in a size of the element, a mass and the start, in one direction."""

    def end(x, tolerance, member):
        arm, start, forces, t1 = random_scene(x, x, 0.1 * (x - 1), member)
        found = fj.simulate(
            arm, start, jnp.array([0, t1]), forces, rtol=tolerance, atol=tolerance,
            adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        return found.q[-1], found.stats["num_switches"]

    members = jax.tree.map(lambda row: row[::3], random_members())

    @partial(jax.jit, **LOOPS)
    def slopes(x, tolerance):
        # One element after the other, as the steps that they need differ.
        each = len(members[0]) // len(ELEMENTS)
        of_one = lambda member: jax.jvp(
            partial(end, tolerance=tolerance, member=member), (x,), (1.0,), has_aux=True
        )
        return jax.lax.map(of_one, members, batch_size=each)

    def differences(h):
        ends = lambda x: slopes(x, 1e-13)[0]
        slope = lambda h: (ends(1 + h) - ends(1 - h)) / (2 * h)
        return (4 * slope(h) - slope(2 * h)) / 3

    # The better of two: rounding weighs more in the closer one, and some motions have a
    # switch more or less within the wider one.
    exact = jnp.stack([differences(h) for h in (1e-4, 1e-5)])
    for tolerance, bound in ((1e-11, 1e-6), (1e-13, 1e-8)):
        _, found, switches = slopes(1.0, tolerance)
        error = jnp.linalg.norm(found[None] - exact, axis=-1).min(axis=0)
        assert (error / jnp.linalg.norm(found, axis=-1)).max() < bound
        assert (switches > 0).mean() > 0.5
