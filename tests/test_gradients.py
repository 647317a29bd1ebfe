"""Gradients of the tracking loss: forward, reverse and central differences agree."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.control import tip_deviation

TS = np.linspace(0, 1.0, 21)
ZERO = jnp.zeros(3)


def scene_at(parameters):
    """Fig 7 as a function of log kp, log kd and log masses, (9,)."""
    scene = scenes.fig7()
    controller = scene.forces[0]
    log_kp, log_kd, log_mass = parameters.reshape(3, 3)
    controller = eqx.tree_at(
        lambda c: (c.kp, c.kd),
        controller,
        (controller.kp * jnp.exp(log_kp), controller.kd * jnp.exp(log_kd)),
    )
    linkage = eqx.tree_at(
        lambda x: x.mass, scene.linkage, scene.linkage.mass * jnp.exp(log_mass)
    )
    return linkage, scene.state0, controller


# A step over the end of a saturation is as short as the kink there demands, about the
# square root of the tolerance, and leaves tangents wrong by its length: 1.4e-6 of the
# gradient at 1e-11, 8e-7 at 1e-12, 1.4e-7 at 1e-13.
STEPS = {
    "fixed": dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=1 / 1600),
    "adaptive": dict(stepsize_controller=diffrax.PIDController(rtol=1e-13, atol=1e-13)),
}


def loss(parameters, steps, adjoint):
    linkage, state0, controller = scene_at(parameters)
    solution = fj.simulate(
        linkage, state0, TS, (controller,), adjoint=adjoint, max_steps=4096, **steps
    )
    return jnp.mean(tip_deviation(linkage, controller.reference, solution) ** 2)


@pytest.mark.parametrize("kind", STEPS)
def test_forward_reverse_and_differences_agree(kind):
    steps = STEPS[kind]
    # Off the paper's gains: nothing is special about this point.
    at = jnp.array([0.1, -0.2, 0.3, 0.05, 0.2, -0.1, 0.0, 0.1, -0.1])
    forward = jax.jit(jax.jacfwd(lambda p: loss(p, steps, diffrax.ForwardMode())))(at)
    reverse = jax.jit(
        jax.grad(lambda p: loss(p, steps, diffrax.RecursiveCheckpointAdjoint()))
    )(at)
    value = jax.jit(lambda p: loss(p, steps, diffrax.ForwardMode()))

    def difference(direction, h):
        return float(value(at + h * direction) - value(at - h * direction)) / (2 * h)

    if kind == "fixed":
        # Free of noise, but with a kink wherever a switching meets a step.
        differences = [difference(e, 1e-6) for e in np.eye(at.size)]
    else:
        # Noise of the tolerance: long steps, extrapolated.
        differences = [
            (4 * difference(e, 5e-4) - difference(e, 1e-3)) / 3 for e in np.eye(at.size)
        ]
    scale = np.abs(forward).max()
    # Both round differently: beside a saturation that leads to other adaptive steps.
    same = {"fixed": 1e-10, "adaptive": 1e-6}[kind]
    assert np.abs(forward - reverse).max() <= same * scale
    assert np.abs(forward - np.array(differences)).max() <= 1e-6 * scale


@pytest.mark.slow
def test_gradient_of_a_batch_is_the_sum_of_the_gradients():
    def total(mass, starts):
        linkage = eqx.tree_at(lambda x: x.mass, scenes.fig5().linkage, mass)
        motion = jax.vmap(
            lambda q: fj.simulate(linkage, fj.State(q, jnp.zeros(3)), [0, 0.5]).q[-1]
        )
        return jnp.sum(motion(starts) ** 2)

    starts = np.array([[0.1, 0.2, 0.3], [-0.5, 0.4, 0.0], [1.0, -1.0, 0.5]])
    mass = jnp.array([1.0, 1.2, 0.8])
    together = jax.grad(total)(mass, starts)
    alone = sum(jax.grad(total)(mass, start[None]) for start in starts)
    np.testing.assert_allclose(together, alone, rtol=1e-8)


def test_gradients_at_rest_and_at_zero_error_are_finite():
    """Hanging still, on the circle's start, with nothing to correct."""
    linkage = scenes.fig7().linkage
    task = fj.CircleTask(center=(-4.0, 2.0), radius=0.5)
    q = fj.inverse_kinematics(linkage, task.tip(0.0), task.orientation)

    def end(kp, q0):
        controller = fj.PDController(kp, [80.0, 50.0, 50.0], [jnp.inf] * 3, task)
        state = fj.State(q0, jnp.zeros(3))
        return jnp.sum(fj.simulate(linkage, state, [0, 0.1], (controller,)).q[-1])

    gradients = jax.grad(end, argnums=(0, 1))(jnp.array([1500.0, 20000.0, 800.0]), q)
    assert all(np.isfinite(g).all() for g in gradients)


def test_bounded_steps_control_the_tangents_of_a_hanging_arm():
    """At rest there is no error to see: unbounded steps leave a wrong gradient."""
    linkage = eqx.tree_at(
        lambda x: x.inertia, scenes.fig5().linkage, jnp.full(3, 1 / 12)
    )
    hanging, still, end = jnp.array([-jnp.pi / 2, 0.0, 0.0]), jnp.zeros(3), 10.0

    def final(q0, dtmax):
        steps = diffrax.PIDController(rtol=1e-11, atol=1e-11, dtmax=dtmax)
        return fj.simulate(
            linkage,
            fj.State(q0, still),
            [0, end],
            stepsize_controller=steps,
            adjoint=diffrax.ForwardMode(),
        ).q[-1]

    # The linear motion about the equilibrium.
    stiffness = jax.jacfwd(lambda q: fj.forward_dynamics(linkage, q, still, still))(
        hanging
    )
    rates = jnp.block([[jnp.zeros((3, 3)), jnp.eye(3)], [stiffness, jnp.zeros((3, 3))]])
    exact = jax.scipy.linalg.expm(rates * end, max_squarings=32)[:3, :3]
    gradient = jax.jit(jax.jacfwd(final))
    scale = np.abs(exact).max()
    assert np.abs(gradient(hanging, 0.1) - exact).max() <= 1e-6 * scale
    assert np.abs(gradient(hanging, 10.0) - exact).max() > scale


@pytest.mark.slow
def test_derivatives_in_the_times_themselves():
    scene = fj.scenes.fig5()

    def loss(factor):
        ts = factor * jnp.array([0.0, 0.1, 0.3])
        motion = fj.simulate(scene.linkage, scene.state0, ts)
        return jnp.sum(motion.ts**2) + jnp.sum(motion.q[-1])

    difference = (loss(1 + 1e-5) - loss(1 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(loss)(1.0), difference, rtol=1e-7)


@pytest.mark.slow
def test_a_function_may_close_over_what_is_differentiated():
    scene = scenes.fig5()

    def end(damping, make):
        forces = (make(damping),)
        return fj.simulate(scene.linkage, scene.state0, [0, 0.3], forces).q[-1, 0]

    closed = jax.value_and_grad(end)(0.5, lambda c: lambda t, q, qd, linkage: -c * qd)
    held = jax.value_and_grad(end)(0.5, fj.JointDamper)
    np.testing.assert_allclose(closed, held, rtol=1e-8)

    def controller(c):
        return fj.PDController(1.0, 1.0, 9.0, lambda t, linkage: (c * ZERO, ZERO))

    with pytest.raises(TypeError, match="^forces: expected what is differentiated"):
        jax.grad(end)(0.5, controller)
