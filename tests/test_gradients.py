"""Gradients of the tracking loss: forward, reverse and central differences agree."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT
from modes import ADJOINT, LOOPS
from test_tangents import ARM, POINTS, tangents, tracked

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.tuning.losses import tip_deviation

TS = np.linspace(0, 1.0, 21)
ZERO = jnp.zeros(2)


def outcome(problem, parameters, adjoint=diffrax.ForwardMode()):
    """Returns the mean squared tip deviation and the last positions.

    They are functions of log kp, log kd, log masses and a shift of the start,
    (8,). The problem (start, controller, times, steps) consists of values only, so
    one program in forward mode and one in reverse mode serve all tests. They know the
    arm's topology.
    """
    state0, controller, ts, (steps, dt0) = problem
    log_kp, log_kd, log_mass, shift = parameters.reshape(4, 2)
    controller = eqx.tree_at(
        lambda c: (c.kp, c.kd),
        controller,
        (controller.kp * jnp.exp(log_kp), controller.kd * jnp.exp(log_kd)),
    )
    linkage = eqx.tree_at(lambda x: x.mass, ARM, ARM.mass * jnp.exp(log_mass))
    solution = fj.simulate(
        linkage,
        state0._replace(q=state0.q + shift),
        ts,
        (controller,),
        stepsize_controller=steps,
        dt0=dt0,
        adjoint=adjoint,
        max_steps=4096,
    )
    deviation = tip_deviation(linkage, controller.reference, solution)
    return jnp.mean(deviation**2), solution.q[-1]


@eqx.filter_jit(**LOOPS)
def forward(problem, at):
    """Returns slopes and values from one program."""

    def twice(at):
        found = outcome(problem, at)
        return found, found

    return jax.jacfwd(twice, has_aux=True)(at)


@eqx.filter_jit(**LOOPS)
def reverse(problem, at, weights):
    """Returns the gradient of the weighted sum of the deviation and the positions."""

    def weighed(at):
        loss, q = outcome(problem, at, ADJOINT)
        return weights[0] * loss + weights[1] * jnp.sum(q)

    return jax.grad(weighed)(at)


def steps(tolerance, dt0=1e-3, growth=10.0):
    """Returns fixed steps of `dt0`, or adaptive steps; both have the same structure."""
    values = dict(rtol=tolerance, atol=tolerance, factormin=0.2, factormax=growth)
    values = {name: np.asarray(value) for name, value in values.items()}
    return diffrax.PIDController(**values), np.asarray(dt0)


# A step over the end of a saturation is as short as the kink there demands, about the
# square root of the tolerance, and leaves tangents wrong by its length: 3e-7 s at a
# tolerance of 1e-13. How much of that step is wrong depends on rounding.
STEPS = {"fixed": steps(1e9, 1 / 1024, growth=1.0), "adaptive": steps(1e-13)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", STEPS)
def test_forward_reverse_and_differences_agree(kind):
    scene = POINTS["start"]
    problem = scene.state0, scene.forces[0], TS, STEPS[kind]
    # An ordinary point.
    at = [0.1, -0.2, 0.05, 0.2, -0.1, 0.1, 0.02, 0.1]
    at = jnp.array(at)
    (tangents, _), _ = forward(problem, at)
    gradient = reverse(problem, at, jnp.array([1.0, 0.0]))

    def difference(direction, h):
        ends = [forward(problem, at + s * h * direction) for s in (1, -1)]
        after, before = (loss for _, (loss, _) in ends)
        return float(after - before) / (2 * h)

    if kind == "fixed":
        # No noise, but a kink wherever a switching meets a step.
        differences = [difference(e, 1e-6) for e in np.eye(at.size)]
    else:
        # Noise of the tolerance: long steps, extrapolated.
        differences = [
            (4 * difference(e, 5e-4) - difference(e, 1e-3)) / 3 for e in np.eye(at.size)
        ]
    scale = np.abs(tangents).max()
    # The modes round differently, which changes adaptive steps beside a saturation.
    same = {"fixed": 1e-10, "adaptive": 1e-6}[kind]
    assert np.abs(tangents - gradient).max() <= same * scale
    assert np.abs(tangents - np.array(differences)).max() <= 1e-6 * scale


@pytest.mark.slow
@pytest.mark.parametrize("point", POINTS)
def test_both_modes_are_the_tangents_that_tuning_follows(point):
    scene = POINTS[point]
    problem = scene.state0, scene.forces[0], TS, STEPS["adaptive"]
    *_, gradient = tangents(scene, 1e-11, TS)
    wanted = gradient / 2  # the loss is a mean over both coordinates too
    (slopes, _), _ = forward(problem, jnp.zeros(8))
    gradient = reverse(problem, jnp.zeros(8), jnp.array([1.0, 0.0]))
    near = (1e-5 if point == "saturated" else 1e-6) * np.linalg.norm(wanted)
    assert np.linalg.norm(slopes[:4] - wanted) < near
    assert np.linalg.norm(gradient[:4] - wanted) < near


def test_both_modes_of_a_damped_arm_equal_differences():
    """Uses fixed steps; derivatives in masses, damping and start."""

    def end(at, adjoint):
        mass, coefficient, q = at.reshape(3, 2)
        linkage = eqx.tree_at(lambda x: x.mass, RODS, mass)
        forces = (fj.JointDamper(coefficient),)
        start, steps = fj.State(q, ZERO), diffrax.ConstantStepSize()
        motion = fj.simulate(
            linkage, start, [0, 0.5], forces,
            stepsize_controller=steps, dt0=1 / 64, adjoint=adjoint,
        )  # fmt: skip
        return jnp.sum(motion.q[-1] * jnp.array([1.0, -2.0]))

    at = jnp.array([2.0, 1.0, 3.0, 0.5, 0.3, -0.2])
    both = jax.jit(jax.value_and_grad(lambda at: end(at, ADJOINT)), **LOOPS)
    forward = jax.jit(jax.jacfwd(lambda at: end(at, diffrax.ForwardMode())))(at)
    value = lambda change: float(both(at + change)[0])
    h = 1e-5
    differences = [(value(h * e) - value(-h * e)) / (2 * h) for e in np.eye(at.size)]
    np.testing.assert_allclose(both(at)[1], forward, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(forward, differences, rtol=1e-6, atol=1e-8)
    assert (np.abs(forward) > 1e-6).all()


@pytest.mark.slow
def test_gradients_at_and_beyond_a_limit_are_finite_and_zero():
    """The efforts are their limits at the start, or everywhere."""
    _, start, (controller,), _ = tracked()
    demand = jnp.abs(eqx.filter_jit(controller.demand)(0.0, *start, ARM))
    slopes = {}
    for name, limit in (("at", demand), ("beyond", np.full(2, 1e-3))):
        limited = eqx.tree_at(lambda c: c.limit, controller, limit)
        problem = start, limited, np.linspace(0, 0.1, 21), steps(1e-11)
        slopes[name] = reverse(problem, jnp.zeros(8), jnp.array([0.0, 1.0]))
    assert np.isfinite(slopes["at"]).all()
    of_gains, others = slopes["beyond"][:4], slopes["beyond"][4:]
    assert not of_gains.any() and np.isfinite(others).all() and others.any()


RODS = fj.Linkage(
    "RR", length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1, 1], inertia=[1 / 12] * 2
)


@pytest.mark.slow
def test_derivatives_in_the_times_themselves():
    scene = fj.scenes.double_pendulum()

    def loss(factor):
        ts = factor * jnp.array([0.0, 0.1, 0.3])
        motion = fj.simulate(scene.linkage, scene.state0, ts)
        return jnp.sum(motion.ts**2) + jnp.sum(motion.q[-1])

    both = jax.jit(jax.value_and_grad(loss))
    difference = (both(1 + 1e-5)[0] - both(1 - 1e-5)[0]) / 2e-5
    np.testing.assert_allclose(both(1.0)[1], difference, rtol=1e-7)


@pytest.mark.slow
def test_a_function_may_close_over_what_is_differentiated():
    scene, zero = scenes.double_pendulum(), jnp.zeros(2)

    def end(damping, make):
        forces = (make(damping),)
        motion = fj.simulate(scene.linkage, scene.state0, [0, 0.3], forces, **SHORT)
        return motion.q[-1, 0]

    both = jax.jit(
        jax.value_and_grad(lambda c: end(c, lambda c: lambda t, q, qd, arm: -c * qd))
    )
    value, slope = both(0.5)
    np.testing.assert_allclose(value, end(0.5, fj.JointDamper), rtol=1e-12)
    ends = [both(0.5 + h)[0] for h in (1e-4, -1e-4, 2e-4, -2e-4)]
    difference = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / 12e-4
    np.testing.assert_allclose(slope, difference, rtol=1e-8)

    def controller(c):
        return fj.PDController(1.0, 1.0, 9.0, lambda t, linkage: (c * zero, zero))

    with pytest.raises(TypeError, match="^forces: expected differentiated arrays"):
        jax.grad(end)(0.5, controller)


def test_modes_that_the_adjoint_does_not_serve_name_the_cure():
    linkage, start, *_ = scenes.double_pendulum()

    def end(q, **settings):
        return fj.simulate(linkage, (q, start.qd), [0, 0.01], **settings).q[-1, 0]

    with pytest.raises(TypeError, match=r"adjoint=diffrax\.ForwardMode\(\)"):
        jax.jacfwd(end)(jnp.zeros(2))
    slope = jax.grad(lambda q: end(q, adjoint=diffrax.ForwardMode()))
    with pytest.raises(RuntimeError, match="^reverse-mode .* default adjoint"):
        jax.eval_shape(slope, jnp.zeros(2))
