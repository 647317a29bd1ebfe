"""Gradients of random motions through switches, all topologies, by differences."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import ARM, HOOK, TIP, Hold

import fdof_jax as fj

SCENES = 11  # of each topology, for each element
GOAL = Hold(jnp.array([0.4, -0.3, 0.6]))


def elements_of(size, acts):
    """A limited PD, a cable, stops and a drive; `acts` (4,) is 1 for one of them."""
    pd, cable, stops, drive = acts
    inner = fj.PDController(60.0 * drive, 4.0 * drive, jnp.inf, GOAL)
    return (
        fj.PDController(60.0 * pd, 4.0 * pd, 8.0 * size, GOAL),
        fj.SpringDamper(
            HOOK, TIP, one_sided="cable", stiffness=300.0 * size * cable,
            damping=15.0 * size * cable, rest_length=1.2 * size,
        ),
        fj.forces.JointStops(
            -0.3, 0.6 * size, stiffness=500.0 * stops + 1e-9,
            damping=0.1, smoothing=0.02,
        ),
        fj.control.SpeedLimit(inner, stall=20.0 * size, no_load=4.0),
        fj.JointDamper(0.2),
    )  # fmt: skip


def random_scenes():
    """Existence factors, starts and the acting element: (scene, ...) each."""
    rng = np.random.default_rng(3)
    count = len(fj.TOPOLOGIES) * SCENES
    ef = np.array([np.array(fj.existence_factors(name)) for name in fj.TOPOLOGIES])
    q, qd = rng.uniform(-0.2, 0.5, (count, 3)), rng.uniform(-2, 2, (count, 3))
    each = np.repeat(ef, SCENES, axis=0), q, qd
    scenes = [np.tile(rows, (4, 1)) for rows in each]
    return *scenes, np.repeat(np.eye(4), count, axis=0)


@pytest.mark.slow
def test_gradients_equal_differences():
    """Derivatives in a size of the element, a mass and the start, in one direction."""

    def end(x, tolerance, ef, q, qd, acts):
        arm = fj.Linkage(ef, **ARM | {"mass": jnp.array(ARM["mass"]) * x})
        found = fj.simulate(
            arm, fj.State(q + 0.1 * (x - 1), qd), jnp.array([0, 0.4]),
            elements_of(x, acts), rtol=tolerance, atol=tolerance,
            adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        return found.q[-1], (found.q[-1], found.stats["num_switches"])

    scenes = random_scenes()
    over_scenes = jax.vmap(jax.jacfwd(end, has_aux=True), (None, None, 0, 0, 0, 0))
    slopes = jax.jit(lambda x, tolerance: over_scenes(x, tolerance, *scenes))

    def differences(h):
        ends = lambda x: slopes(x, 1e-13)[1][0]
        slope = lambda h: (ends(1 + h) - ends(1 - h)) / (2 * h)
        return (4 * slope(h) - slope(2 * h)) / 3

    # The better of two: rounding weighs more in the closer one, and some motions have a
    # switch more or less within the wider one.
    exact = jnp.stack([differences(h) for h in (1e-4, 1e-5)])
    for tolerance, bound in ((1e-11, 1e-6), (1e-13, 1e-8)):
        found, (_, switches) = slopes(1.0, tolerance)
        error = jnp.linalg.norm(found[None] - exact, axis=-1).min(axis=0)
        assert (error / jnp.linalg.norm(found, axis=-1)).max() < bound
        assert (switches > 0).mean() > 0.5
