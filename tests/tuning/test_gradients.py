"""Gradients of the tracking loss: all modes and central differences agree."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import ADJOINT, LOOPS

import fdof_jax as fj
from fdof_jax.tuning.losses import gains_of, tip_deviation, tip_errors, with_gains

# The arm of Fig 7 up to its slide, as programs of two joints compile faster. There too
# the slide's controller starts at its limit, to which it comes back.
ARM = fj.Linkage(
    "RP", length=[0, 1, 2.5], com=[[1, 0], [2.5, 0]], mass=[1, 1], inertia=[1, 1],
    locked=[0, np.pi / 2],
)  # fmt: skip
START = fj.State(np.array([np.pi / 2, 2.5]), np.zeros(2))
TS = np.linspace(0, 1.0, 21)
# A step over the end of a saturation is as short as the kink there demands, about the
# square root of the tolerance, and leaves tangents wrong by its length: 3e-7 s at a
# tolerance of 1e-13. How much of that step is wrong depends on rounding.
STEPS = diffrax.PIDController(np.array(1e-13), np.array(1e-13))


def tracked(
    kp=(1500.0, 20000.0), kd=(80.0, 50.0), limit=(1000.0, 300.0), center=(-5.4, 0.4),
    radius=0.5,
):  # fmt: skip
    """Returns a scene whose tip moves to a circle and along it."""
    path = fj.references.Ellipse(center, [radius, radius])
    laps = fj.references.Laps(period=2.0)
    circle = fj.references.TipTask(path, laps, orientation=None)
    limit = np.broadcast_to(limit, 2)
    forces = (fj.PDController(kp, kd, limit, circle),)
    return jax.tree.map(jnp.asarray, fj.Scene(ARM, START, forces, 1.0))


# At gains like those of Fig 7, at higher ones, and with a slide at its limit half of
# the time.
POINTS = {
    "start": tracked(),
    "end": tracked(kp=(6000.0, 11700.0), kd=(320.0, 200.0)),
    "saturated": tracked(limit=(1000.0, 60.0)),
}


def changed(scene, numbers):
    """Returns a scene with other gains, masses and start, by logarithms and a shift."""
    log_gains, log_mass, shift = numbers[:4], numbers[4:6], numbers[6:]
    gains = gains_of(scene)
    scene = with_gains(scene, gains * jnp.exp(log_gains).reshape(gains.shape))
    arm = eqx.tree_at(lambda a: a.mass, scene.linkage, ARM.mass * jnp.exp(log_mass))
    start = scene.state0._replace(q=scene.state0.q + shift)
    return scene._replace(linkage=arm, state0=start)


def outcome(scene, numbers, ts, adjoint):
    """Returns the mean squared tip deviation, the last positions, and the motion."""
    scene = changed(scene, numbers)
    options = dict(stepsize_controller=STEPS, adjoint=adjoint, max_steps=4096)
    motion = fj.simulate(scene, ts, **options)
    deviation = tip_deviation(scene.linkage, scene.forces[0].reference, motion)
    return jnp.stack([jnp.mean(deviation**2), jnp.sum(motion.q[-1])]), motion


@eqx.filter_jit(**LOOPS)
def forward(scene, numbers, ts):
    """Returns slopes and values from one program."""

    def twice(numbers):
        found, _ = outcome(scene, numbers, ts, diffrax.ForwardMode())
        return found, found

    return jax.jacfwd(twice, has_aux=True)(numbers)


@eqx.filter_jit(**LOOPS)
def reverse(scene, numbers, ts, weights):
    """Returns the gradient of the weighted deviation and positions, and steps."""

    def weighed(numbers):
        found, motion = outcome(scene, numbers, ts, ADJOINT)
        return weights @ found, motion.stats["num_steps"]

    return jax.grad(weighed, has_aux=True)(numbers)


@eqx.filter_jit(**LOOPS)
def tangents(scene, ts):
    """Returns residuals and Jacobian in the log-gains, as tuning follows them."""
    at = lambda z: changed(scene, jnp.append(z, jnp.zeros(4)))
    found = fj.simulation.sensitivities(at, tip_errors, jnp.zeros(4), ts, 1e-11)
    return found.residuals, found.jacobian


@pytest.mark.slow
@pytest.mark.parametrize("point", POINTS)
def test_all_modes_and_differences_agree(point):
    scene, none = POINTS[point], jnp.zeros(8)
    (slopes, _), _ = forward(scene, none, TS)
    gradient, steps = reverse(scene, none, TS, jnp.array([1.0, 0.0]))

    def difference(direction, h):
        after, before = (forward(scene, s * h * direction, TS)[1] for s in (1, -1))
        return float(after[0] - before[0]) / (2 * h)

    # Noise of the tolerance: long steps, extrapolated.
    differences = [
        (4 * difference(e, 5e-4) - difference(e, 1e-3)) / 3 for e in np.eye(8)
    ]
    scale = np.abs(slopes).max()
    near = 1e-5 if point == "saturated" else 1e-6
    # The modes round differently, which changes adaptive steps beside a saturation.
    assert np.abs(slopes - gradient).max() <= near * scale
    assert np.abs(slopes - np.array(differences)).max() <= near * scale
    residuals, jacobian = tangents(scene, TS)
    followed = jacobian.T @ residuals  # of half the squares, a mean over two
    assert np.linalg.norm(slopes[:4] - followed) <= near * np.linalg.norm(followed)
    # The probe of the adjoint hardly shortens the steps of a motion that goes on.
    plain = fj.simulate(scene, TS, stepsize_controller=STEPS, max_steps=4096)
    assert steps <= 1.1 * plain.stats["num_steps"]


@pytest.mark.slow
def test_nothing_is_nan_at_rest_at_zero_error_or_at_and_beyond_a_limit():
    """An ellipse without axes, where the tip is."""
    tip = tuple(np.asarray(fj.tip_position(ARM, START.q)))
    for gravity in (0.0, 9.81):
        for limit in (0.0, 1e-9, 300.0, np.inf):
            scene = tracked(limit=limit, center=tip, radius=0.0)
            arm = ARM.replace(gravity=jnp.asarray(gravity))
            residuals, jacobian = tangents(scene._replace(linkage=arm), TS)
            assert np.isfinite(residuals).all() and np.isfinite(jacobian).all()
            if gravity == 0:
                assert np.abs(residuals).max() < 1e-12
    # The efforts are their limits at the start, or everywhere.
    scene, slopes = tracked(), {}
    demand = jnp.abs(eqx.filter_jit(scene.forces[0].demand)(0.0, *START, ARM))
    for name, limit in (("at", demand), ("beyond", np.full(2, 1e-3))):
        limited = tracked(limit=limit), jnp.zeros(8), np.linspace(0, 0.1, 21)
        slopes[name], _ = reverse(*limited, jnp.array([0.0, 1.0]))
    assert np.isfinite(slopes["at"]).all()
    of_gains, others = slopes["beyond"][:4], slopes["beyond"][4:]
    assert not of_gains.any() and np.isfinite(others).all() and others.any()


@pytest.mark.slow
def test_derivatives_in_output_times_and_in_what_a_function_closes_over():
    scene = fj.scenes.double_pendulum()

    @jax.jit
    @jax.value_and_grad
    def both(numbers):
        factor, damping = numbers
        ts = factor * jnp.array([0.0, 0.1, 0.3])
        forces = (lambda t, q, qd, linkage: -damping * qd,)
        motion = fj.simulate(scene.linkage, scene.state0, ts, forces)
        return jnp.sum(motion.ts**2) + jnp.sum(motion.q[-1])

    at = jnp.array([1.0, 0.5])
    ends = [(both(at + h)[0] - both(at - h)[0]) / 2e-5 for h in 1e-5 * np.eye(2)]
    np.testing.assert_allclose(both(at)[1], ends, rtol=1e-7)


def test_modes_that_are_not_served_name_the_cure():
    rod = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])

    def end(q, forces=(), **settings):
        state0 = fj.State(q, jnp.zeros(1))
        return fj.simulate(rod, state0, [0, 0.01], forces, **settings).q[-1, 0]

    with pytest.raises(TypeError, match=r"adjoint=diffrax\.ForwardMode\(\)"):
        jax.jacfwd(end)(jnp.zeros(1))
    slope = jax.grad(lambda q: end(q, adjoint=diffrax.ForwardMode()))
    with pytest.raises(RuntimeError, match="^reverse-mode .* default adjoint"):
        jax.eval_shape(slope, jnp.zeros(1))

    def closed_over(c):
        target = lambda t, linkage: (c * jnp.ones(1), jnp.zeros(1))
        return end(jnp.ones(1), (fj.PDController(1.0, 1.0, 9.0, target),))

    with pytest.raises(TypeError, match="^forces: expected differentiated arrays"):
        jax.grad(closed_over)(0.5)
