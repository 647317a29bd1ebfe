"""Searches take scenes whose joints are held: derivatives beside the motion agree."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from modes import LOOPS, jacobian

import fdof_jax as fj

ARM = fj.scenes.double_pendulum().linkage
START = fj.State([0.3, -0.2], [0.0, 0.0])
BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
REST = fj.State([0.3], [0.0])
TS = np.linspace(0, 1, 11)


@pytest.mark.slow
def test_derivatives_beside_the_motion_are_those_through_it():
    """Those in times of events; the others below are held against differences."""

    def scene_at(z):
        brake = fj.forces.Brake(1, z[0], z[1])
        payload = fj.forces.Payload(fj.Point(1, 0.8), z[2], begin=z[3], end=z[4])
        return fj.Scene(BAR, REST, (fj.JointDamper(0.5), brake, payload), 1.0)

    def through(z):
        scene = scene_at(z)
        forward = diffrax.ForwardMode()
        return fj.simulate(scene, TS, adjoint=forward).q.reshape(-1)

    def beside(z):
        angles = lambda _, motion: motion.q.reshape(-1)
        found = fj.simulation.sensitivities(scene_at, angles, z, TS, 1e-11)
        return found.residuals, found.jacobian

    z = jnp.array([0.3, 0.6, 1.0, 0.2, 0.8])
    motion, slopes = jax.jit(beside, **LOOPS)(z)
    right, exact = jacobian(through)(z)
    np.testing.assert_allclose(motion, exact, atol=1e-9)
    np.testing.assert_allclose(slopes, right, atol=1e-7)
    assert (np.abs(right).max(axis=0) > 0.01).all()


@pytest.mark.slow
def test_standard_errors_through_all_that_holds():
    """Those from extrapolated differences of tight solves; the truth is within four."""
    move = fj.references.JointMove(START.q, [0.8, 0.6], fj.references.Travel(0.7))
    control = fj.PDController([200, 40], [20, 1], 100, move)

    def scene_at(p):
        level, static = (jnp.stack([0.0, p[name]]) for name in ("level", "static"))
        forces = (
            control,
            fj.forces.JointFriction(level, static),
            fj.forces.HardStops(-np.inf, [np.inf, 0.1], restitution=p["restitution"]),
            fj.forces.Payload(fj.Point(2, 0.8), p["mass"], begin=p["time"]),
        )
        return fj.Scene(ARM, START, forces, 1.5)

    def seen_at(p):
        scene = scene_at(p)
        motion = fj.simulate(scene, ts, rtol=1e-13, atol=1e-13)
        return fj.identification.link_ends(scene, motion)

    ts, noise = np.linspace(0, 1.5, 151), 1e-4
    truth = dict(level=1.0, static=2.0, restitution=0.6, mass=0.4, time=0.25)
    truth = jax.tree.map(jnp.array, truth)
    seen = seen_at(truth)
    seen += noise * np.random.default_rng(0).normal(size=seen.shape)
    start = dict(level=1.3, static=2.5, restitution=0.4, mass=0.5, time=0.28)
    bounds = dict(restitution=(0.05, 0.95))
    found = fj.fit(scene_at, start, ts, seen, noise=noise, bounds=bounds)
    assert found.usable

    numbers, named = ravel_pytree(jax.tree.map(jnp.asarray, found.parameters))

    def difference(change):
        ends = (np.ravel(seen_at(named(numbers + x * change))) for x in (1, -1))
        return np.subtract(*ends) / (2 * change.sum())

    changes = 3e-5 * np.eye(numbers.size)
    columns = [(4 * difference(h) - difference(2 * h)) / 3 for h in changes]
    right = noise * np.sqrt(np.diag(np.linalg.inv(np.inner(columns, columns))))
    errors = ravel_pytree(found.standard_errors)[0]
    np.testing.assert_allclose(errors, right, rtol=1e-4)
    assert (np.abs(numbers - ravel_pytree(truth)[0]) < 4 * errors).all()


@pytest.mark.slow
def test_gains_are_tuned_while_friction_holds_a_joint():
    """The loss is that of the motion, and gains that are a little less do worse."""
    move = fj.references.JointMove(START.q, [0.8, 0.6], fj.references.Travel(0.7))
    control = fj.PDController([200, 100], [20, 10], 100, move)
    forces = control, fj.forces.JointFriction([4.0, 2.0], [6.0, 3.0])
    scene = fj.Scene(ARM, START, forces, 1.0)
    ts = np.linspace(0, scene.t1, 1001)

    def loss(scene):
        motion = fj.simulate(scene, ts)
        return float((fj.tuning.joint_errors(scene, motion) ** 2).sum()), motion

    found = fj.tune(scene, loss=fj.tuning.joint_errors)
    best, motion = loss(found.scene)
    np.testing.assert_allclose(found.loss, best, rtol=1e-5)
    assert found.converged and best < 0.5 * loss(scene)[0]
    assert (motion.modes == 1).any()
    less = control.replace(kp=0.98 * found.gains[0], kd=0.98 * found.gains[1])
    assert loss(scene._replace(forces=(less, forces[1])))[0] > best
