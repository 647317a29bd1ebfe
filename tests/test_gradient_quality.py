"""The gradients that tuning follows, compared with differences and other modes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.simulation.jacobian import jacobian_of
from fdof_jax.tuning import gradient_quality
from fdof_jax.tuning.losses import gains_of, tip_errors, with_gains

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
    found = jacobian_of(at, tip_errors, zero, ts, tolerance)
    gradient = 2 * found.jacobian.T @ found.residuals
    return found.residuals, found.jacobian, gradient


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
    # The gradients that tuning uses.
    timed = jax.tree.map(jnp.asarray, scene._replace(t1=3.0))
    found, _ = gradient_quality._tangents(timed, np.zeros(4))
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


@pytest.fixture(scope="module")
def report():
    return fj.tuning.gradient_report(scenes.fig7()._replace(t1=2.0))


@pytest.mark.slow
def test_the_report_is_what_it_says(report):
    halfway, exact = by_differences(scenes.fig7(), np.linspace(0, 2, 1001))
    size = np.linalg.norm(exact)
    for found in (report.gradient, report.differences):
        assert np.linalg.norm(found.ravel() - exact) < 1e-5 * size
    # One sample of the horizon apart.
    assert report.gradient_norm[-1] == pytest.approx(size, rel=1e-3)
    halfway = halfway * 1001 / 501
    assert report.gradient_norm[4] == pytest.approx(np.linalg.norm(halfway), rel=1e-3)
    assert report.horizons[4] == pytest.approx(1.0)
    assert 0.1 < report.saturated[1] < 0.13
    assert "P2 is at its limit for" in str(report)
    # The slide at its limit is not damped; within the limits all joints are.
    assert report.at_limit.shape == (101,) and 0.1 < report.at_limit.mean() < 0.13
    damping = report.modes.damping
    assert np.nanmin(damping[report.at_limit]) < 0.01 < damping[~report.at_limit].min()
    assert "while actuators are at their limits:" in str(report)
    assert f"{report.error:.1e} of its norm" in str(report)
    assert report.modes.eigenvalues.shape == (101, 6)
    # The slide leaves its limit, and comes back to it, a few times.
    assert 1 <= report.switches < 20 and 0.01 < report.slowest_crossing < 100
    assert f"{report.switches} switches between" in str(report)
    # The circle's period is the only time that this scene holds.
    ((name, (slope, difference)),) = report.times.items()
    assert name == "forces[0].reference.period" and abs(slope) > 1e-4
    assert slope == pytest.approx(difference, rel=1e-4)
    assert f"derivative in {name}: {slope:.3g} m^2/s" in str(report)
    assert "disagree" not in str(report)


@pytest.mark.slow
def test_a_report_says_where_gains_have_no_effect():
    scene = scenes.fig7()
    weak = scene.forces[0].replace(limit=[1000.0, 1e-6, 400.0])
    found = fj.tuning.gradient_report(scene._replace(forces=(weak,), t1=0.5))
    assert not found.gradient[:, 1].any() and found.saturated[1] == 1
    assert "P2 is at its limit throughout" in found.warnings[0]


@pytest.mark.slow
def test_a_reference_without_a_tip_is_judged_by_the_joints():
    arm = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
    step = fj.references.Step([-1.5], [-1.3], begin=0.05)
    forces = (fj.PDController([60.0], [20.0], 30.0, step),)
    scene = fj.Scene(arm, fj.State([-1.5], [0]), forces, 0.5)
    found = fj.tuning.gradient_report(scene)
    ts = np.linspace(0, 0.5, 1001)

    def loss(logs):
        gains = jnp.exp(logs)
        pd = forces[0].replace(kp=gains[0], kd=gains[1])
        motion = fj.simulate(arm, scene.state0, ts, (pd,), rtol=1e-10, atol=1e-10)
        wanted = np.where(ts[:, None] < 0.05, step.before, step.after)
        return jnp.mean(jnp.sum((motion.q - wanted) ** 2, axis=1))

    exact = jax.grad(loss)(jnp.log(jnp.array([[60.0], [20.0]])))
    size = np.linalg.norm(exact)
    assert np.linalg.norm(found.gradient - exact) < 1e-4 * size and found.error < 1e-3
    assert found.gradient_norm[-1] == pytest.approx(size, rel=1e-3)
    assert found.horizons[-1] == 0.5


class Pulse(fj.Element):
    """A torque from a time on, for a while."""

    begin: fj.Values = fj.field((), unit="s")
    length: fj.Values = fj.field((), unit="s")

    def __call__(self, t, q, qd, linkage):
        on = (t >= self.begin) & (t < self.begin + self.length)
        return jnp.where(on, 50.0, 0.0) * jnp.array([1.0, 0])

    @property
    def jump_ts(self):
        return jnp.stack([self.begin, self.begin + self.length])


@pytest.mark.slow
def test_a_report_without_modes_for_elements_with_a_state():
    # Whole numbers in lists are a state too.
    scene = tracked()._replace(t1=0.2, state0=fj.State([2, 3], [0, 0]))
    lag = fj.control.FirstOrderLag(fj.JointEffort(np.ones(2)), 0.1)
    forces = (*scene.forces, lag, Pulse(0.05, 0.07))
    found = fj.tuning.gradient_report(scene._replace(forces=forces))
    # P2 is at its limit throughout: the gradient is small, and most of it noise.
    assert found.modes is None and found.error < 1e-2
    assert "natural frequencies" not in str(found)
    # Derivatives in times at which efforts jump.
    period = "forces[0].reference.timing.period"
    names = [period, "forces[2].begin", "forces[2].length"]
    assert list(found.times) == names
    for slope, difference in found.times.values():
        assert slope == pytest.approx(difference, rel=1e-3)


def test_a_mode_too_fast_for_explicit_methods_is_told():
    at = lambda rate: fj.analysis.Modes(np.array([[-1.0, -rate, np.nan]]))
    (words,) = gradient_quality._stiffness(at(2e5), 10.0)
    assert "2e+05 rad/s takes some 500,000 steps" in words and "Kvaerno5" in words
    assert gradient_quality._stiffness(at(100.0), 10.0) == []
