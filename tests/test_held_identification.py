"""Searches take scenes whose joints are held: derivatives beside the motion agree."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.simulation.sensitivities import sensitivities

ARM = fj.scenes.double_pendulum().linkage
START = fj.State([0.3, -0.2], [0.0, 0.0])
TS = np.linspace(0, 1, 11)
PARAMETERS = jnp.array([0.3, 0.6, 1.0])
HELD = {
    "friction": lambda z: fj.forces.JointFriction(z[2], static=1.5 * z[2]),
    "stops": lambda z: fj.forces.HardStops([-1, -0.5], [z[2], 0.5], restitution=z[0]),
    "brake": lambda z: fj.forces.Brake(2, z[0], z[1]),
    "payload": lambda z: fj.forces.Payload(
        fj.Point(2, 0.8), z[2], begin=z[0], end=z[1]
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HELD)
def test_derivatives_beside_the_motion_are_those_through_it(name):
    def scene_at(z):
        return fj.Scene(ARM, START, (fj.JointDamper(0.5), HELD[name](z)), 1.0)

    def through(z):
        scene = scene_at(z)
        forward = diffrax.ForwardMode()
        return fj.simulate(scene, TS, adjoint=forward).q.reshape(-1)

    def beside(z):
        angles = lambda _, motion: motion.q.reshape(-1)
        found = sensitivities(scene_at, angles, z, jnp.asarray(TS), tolerance=1e-11)
        return found.residuals, found.jacobian

    motion, slopes = jax.jit(beside, **LOOPS)(PARAMETERS)
    np.testing.assert_allclose(motion, through(PARAMETERS), atol=1e-9)
    right = jax.jit(jax.jacfwd(through), **LOOPS)(PARAMETERS)
    np.testing.assert_allclose(slopes, right, atol=1e-7)
    assert np.abs(right).max() > 0.01


@pytest.mark.slow
def test_friction_is_found_from_a_motion_that_sticks():
    move = fj.references.JointMove(START.q, [0.8, 0.6], fj.references.Travel(0.7))
    control = fj.PDController([200, 100], [40, 20], 100, move)

    def scene_at(p):
        return fj.Scene(ARM, START, (control, fj.forces.JointFriction(p["level"])), 1.5)

    ts, truth = np.linspace(0, 1.5, 151), {"level": np.array([4.0, 2.0])}
    scene = scene_at(truth)
    motion = fj.simulate(scene, ts)
    noise = 1e-4 * np.random.default_rng(0).normal(size=(151, 2, 2))
    seen = fj.identification.link_ends(scene, motion) + noise
    found = fj.fit(scene_at, {"level": [3.0, 3.0]}, ts, seen)
    assert found.converged and (motion.modes == 1).any()
    np.testing.assert_allclose(found.parameters["level"], truth["level"], rtol=0.01)
