"""Standard errors of a fit whose scene holds joints are those of differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import fdof_jax as fj

ARM = fj.scenes.double_pendulum().linkage
START = fj.State([0.3, -0.2], [0.0, 0.0])
MOVE = fj.references.JointMove(START.q, [0.8, 0.6], fj.references.Travel(0.7))
CONTROL = fj.PDController([200, 40], [20, 1], 100, MOVE)
TS, NOISE = np.linspace(0, 1.5, 151), 1e-4


def scene_at(p):
    level, static = (jnp.stack([0.0, p[name]]) for name in ("level", "static"))
    forces = (
        CONTROL,
        fj.forces.JointFriction(level, static),
        fj.forces.HardStops(-np.inf, [np.inf, 0.1], restitution=p["restitution"]),
        fj.forces.Payload(fj.Point(2, 0.8), p["mass"], begin=p["time"]),
    )
    return fj.Scene(ARM, START, forces, 1.5)


def seen_at(p):
    scene = scene_at(p)
    motion = fj.simulate(scene, TS, rtol=1e-13, atol=1e-13)
    return fj.identification.link_ends(scene, motion)


@pytest.mark.slow
def test_standard_errors_through_all_that_holds():
    """Those from extrapolated differences of tight solves; the truth is within four."""
    truth = dict(level=1.0, static=2.0, restitution=0.6, mass=0.4, time=0.25)
    truth = jax.tree.map(jnp.array, truth)
    seen = seen_at(truth)
    seen += NOISE * np.random.default_rng(0).normal(size=seen.shape)
    start = dict(level=1.3, static=2.5, restitution=0.4, mass=0.5, time=0.28)
    bounds = dict(restitution=(0.05, 0.95))
    found = fj.fit(scene_at, start, TS, seen, noise=NOISE, bounds=bounds)
    assert found.usable

    numbers, named = ravel_pytree(jax.tree.map(jnp.asarray, found.parameters))

    def difference(change):
        ends = (np.ravel(seen_at(named(numbers + x * change))) for x in (1, -1))
        return np.subtract(*ends) / (2 * change.sum())

    changes = 3e-5 * np.eye(numbers.size)
    columns = [(4 * difference(h) - difference(2 * h)) / 3 for h in changes]
    right = NOISE * np.sqrt(np.diag(np.linalg.inv(np.inner(columns, columns))))
    errors = ravel_pytree(found.standard_errors)[0]
    np.testing.assert_allclose(errors, right, rtol=1e-4)
    assert (np.abs(numbers - ravel_pytree(truth)[0]) < 4 * errors).all()
