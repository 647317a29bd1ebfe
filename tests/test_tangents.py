"""The tangents that tuning follows, compared with differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.tuning.losses import gain_jacobian, gains_of, tip_errors, with_gains

# The arm of Fig 7 up to its slide, as programs of two joints compile faster. There too
# the slide's controller starts at its limit, to which it comes back.
ARM = fj.Linkage(
    "RP", length=[0, 1, 2.5], com=[[1, 0], [2.5, 0]], mass=[1, 1], inertia=[1, 1],
    locked=[0, np.pi / 2],
)  # fmt: skip
CIRCLE = fj.references.TipTask(
    fj.references.Ellipse([-5.4, 0.4], [0.5, 0.5]),
    fj.references.Laps(period=2.0),
    orientation=None,
)


def tracked(kp=(1500.0, 20000.0), kd=(80.0, 50.0), limit=(1000.0, 300.0)):
    """Returns a scene whose tip moves to the circle and along it."""
    start = fj.State(np.array([np.pi / 2, 2.5]), np.zeros(2))
    forces = (fj.PDController(kp, kd, limit, CIRCLE),)
    return jax.tree.map(jnp.asarray, fj.Scene(ARM, start, forces, 1.0))


# At gains like those of Fig 7, at higher ones, and with a slide at its limit half of
# the time.
POINTS = {
    "start": tracked(),
    "end": tracked(kp=(6000.0, 11700.0), kd=(320.0, 200.0)),
    "saturated": tracked(limit=(1000.0, 60.0)),
}


def scaled(scene, z):
    """Returns the scene with gains by the factors exp(z)."""
    gains = gains_of(scene)
    return with_gains(scene, gains * jnp.exp(z).reshape(gains.shape))


@eqx.filter_jit(**LOOPS)
def tangents(scene, tolerance, ts):
    at = lambda z: scaled(scene, z)
    zero = jnp.zeros(gains_of(scene).size)
    found = fj.simulation.sensitivities(at, tip_errors, zero, ts, tolerance)
    gradient = 2 * found.jacobian.T @ found.residuals
    return found.residuals, found.jacobian, gradient


followed = eqx.filter_jit(gain_jacobian, **LOOPS)


def losses(scene, z, ts):
    """Returns sums of squares up to the half and the end, by a plain motion."""
    motion = fj.simulate(scaled(scene, z)._replace(t1=0.0), ts, rtol=1e-13, atol=1e-13)
    squares = np.square(tip_errors(scene, motion))
    return np.array([squares[: len(ts) + 1].sum(), squares.sum()])


def by_differences(scene, ts, h=4e-4):
    """Returns the gradients of both sums in the log-gains (2, n)."""
    slope = lambda e: (losses(scene, e, ts) - losses(scene, -e, ts)) / 2
    units = np.eye(gains_of(scene).size)
    near = np.stack([slope(h / 2 * e) / (h / 2) for e in units], axis=1)
    far = np.stack([slope(h * e) / h for e in units], axis=1)
    return (4 * near - far) / 3


@pytest.mark.slow
@pytest.mark.parametrize("point", POINTS)
def test_tangents_are_those_of_differences(point):
    scene, ts = POINTS[point], np.linspace(0, 3, 1001)
    residuals, _, gradient = tangents(scene, 1e-10, ts)
    _, wanted = by_differences(scene, ts)
    size = np.linalg.norm(wanted)
    assert np.linalg.norm(gradient - wanted) < 1e-6 * size
    _, value = losses(scene, np.zeros(4), ts)
    assert float(residuals @ residuals) == pytest.approx(value, rel=1e-8)
    # Those that tuning uses.
    timed = jax.tree.map(jnp.asarray, scene._replace(t1=3.0))
    found = followed(np.zeros(4), timed, tip_errors)
    coarse = 2 * found.jacobian.T @ found.residuals
    assert np.linalg.norm(coarse - gradient) < 1e-3 * size


@pytest.mark.slow
def test_nothing_is_nan_at_rest_at_zero_error_or_at_saturation():
    scene, ts = tracked(), np.linspace(0, 0.3, 1001)
    q, controller = scene.state0.q, scene.forces[0]

    class At(eqx.Module):  # where the arm is
        def __call__(self, t, linkage):
            return q, jnp.zeros(2)

        def tip(self, t):
            return fj.tip_position(ARM, q)

    for gravity in (0.0, 9.81):
        for limit in (0.0, 1e-9, 300.0, np.inf):
            held = fj.PDController(controller.kp, controller.kd, limit, At())
            arm = eqx.tree_at(lambda a: a.gravity, scene.linkage, jnp.asarray(gravity))
            still = scene._replace(linkage=arm, forces=(held,))
            residuals, _, gradient = tangents(still, 1e-5, ts)
            assert np.isfinite(residuals).all() and np.isfinite(gradient).all()
            if gravity == 0:
                assert not residuals.any() and not gradient.any()
