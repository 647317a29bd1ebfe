"""Switches that follow each other within what would be one step."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS, jacobian
from scipy.integrate import solve_ivp

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1], gravity=0
)
ROTOR = fj.Linkage("R", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], gravity=0)
PENDULUM = fj.scenes.double_pendulum().linkage


def passing(aside, radius, speed, stiffness, end, **options):
    """A slide that passes a round bumper at 2 m, from 0 m on."""
    bumper = fj.SpringDamper(
        fj.Point(0, aside, 2.0), fj.Point(1), stiffness=stiffness, rest_length=radius,
        one_sided="bumper",
    )  # fmt: skip
    start = fj.State(jnp.zeros(1), jnp.reshape(speed, (1,)))
    ts = jnp.stack([jnp.zeros_like(end), end])
    return fj.simulate(SLIDE, start, ts, (bumper,), **options)


@jax.jit
def all_passing(aside, radius, speed, stiffness, end):
    """Of 20 slides, so that one program serves all tests."""
    one = lambda *numbers: passing(*numbers, solver=LoopedDopri8(), throw=False)
    return jax.vmap(one)(aside, radius, speed, stiffness, end)


def integrated(aside, radius, speed, stiffness, end):
    """Returns where SciPy's method ends up in short steps."""

    def rates(t, y):
        along = y[0] - 2
        distance = np.hypot(along, aside)
        push = stiffness * max(radius - distance, 0)
        return [y[1], push * along / distance]

    found = solve_ivp(
        rates, [0, end], [0, speed], "DOP853", max_step=radius / speed / 10,
        rtol=1e-10, atol=1e-11,
    )  # fmt: skip
    return found.y[0, -1]


@pytest.mark.slow
def test_a_bumper_is_met_or_missed_by_little_within_one_step():
    """The first one's end would be 4.7 m without the bumper."""
    aside = np.array([0.01, -0.0029, 0.1 + 1e-6, 0.1 + 1e-3, -0.1 - 1e-6])
    radius = np.array([0.1, 0.003, 0.1, 0.1, 0.1])
    speed, stiffness = np.array([3.7, 1, 3.7, 3.7, 1]), np.full(5, 1e3)
    end = np.array([4.7, 2.5, 4.7, 4.7, 4.7]) / speed
    cases = aside, radius, speed, stiffness, end
    found = jax.tree.map(
        lambda row: row[:5], all_passing(*(np.resize(row, 20) for row in cases))
    )
    assert found.stats["num_switches"].tolist() == [4, 4, 0, 0, 0]
    exact = [integrated(*case) for case in zip(*cases)]
    assert abs(exact[0] - 4.66615) < 1e-5
    np.testing.assert_allclose(found.q[:, -1, 0], exact, atol=1e-8)
    # Without the bumper it takes six steps.
    assert (found.stats["num_steps"][2:] <= 25).all()
    share = np.sqrt(1e-6 / 2)  # it passes at 1e-6 m, of the 2 m at which it began
    assert abs(found.stats["slowest_crossing"][2] / share - 1) < 0.1


@pytest.mark.slow
def test_no_bumper_is_passed_over():
    rng = np.random.default_rng(0)
    radius, speed = 10 ** rng.uniform(np.log10(0.003), -1, 20), rng.uniform(1, 3.7, 20)
    aside, stiffness = rng.uniform(-0.95, 0.95, 20) * radius, np.full(20, 10.0)
    end = rng.uniform(2.5, 4.7, 20) / speed
    found = all_passing(aside, radius, speed, stiffness, end)
    assert (found.stats["num_switches"] >= 2).all()
    exact = [integrated(*c) for c in zip(aside, radius, speed, stiffness, end)]
    np.testing.assert_allclose(found.q[:, -1, 0], exact, atol=1e-8)


@jax.jit
@partial(jax.vmap, in_axes=(0, 0, 0, None, None, None))
def meeting(q, qd, aside, radius, tolerance, max_step):
    """A double pendulum whose tip meets a peg about where it is after 0.4 s."""
    options = dict(solver=LoopedDopri8(), throw=False, max_steps=100_000)
    start = fj.State(q, qd)
    free = fj.simulate(PENDULUM, start, [0, 0.4], (), **options)
    options |= dict(rtol=tolerance, atol=tolerance, max_step=max_step)
    place = fj.tip_position(PENDULUM, free.q[-1]) + aside
    peg = fj.SpringDamper(
        fj.Point(0, *place), fj.Point(2, 1.0), stiffness=1e3, damping=2,
        rest_length=radius, one_sided="bumper",
    )  # fmt: skip
    return fj.simulate(PENDULUM, start, [0, 1.2], (peg,), **options)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.005, 0.02])
def test_no_peg_is_passed_over(radius):
    """Against steps much shorter than the pegs."""
    rng = np.random.default_rng(5)
    q, qd = rng.uniform(-2, 2, (60, 2)) + [0.5, 0], rng.uniform(-3, 3, (60, 2))
    case = q, qd, rng.uniform(-0.6, 0.6, (60, 2)) * radius, radius
    exact = meeting(*case, 1e-11, radius / 40)
    for tolerance, bound in ((1e-11, 1e-9), (1e-6, 1e-4)):
        found = meeting(*case, tolerance, 1.2)  # the whole motion
        assert (found.stats["num_switches"] > 0).all()
        np.testing.assert_allclose(found.q, exact.q, atol=bound)


class Cogging(fj.Element):
    """A torque that changes its sign with the angle, or with the time."""

    waves: fj.Values = fj.field((), unit="1")
    rate: fj.Values = fj.field((), unit="rad/s")
    torque: fj.Values = fj.field((), unit="N m")

    def __call__(self, t, q, qd, linkage):
        wave = jnp.sin(self.waves * q + self.rate * t)
        return fj.forces.switch(wave, self.torque, -self.torque)


@jax.jit
def turning(waves, rate, torque, speed, end):
    def one(waves, rate, torque, speed, end):
        start, ts = fj.State(jnp.zeros(1), speed[None]), jnp.stack([0 * end, end])
        cogging = Cogging(waves, rate, torque)
        options = dict(solver=LoopedDopri8(), throw=False)
        return fj.simulate(ROTOR, start, ts, (cogging,), **options)

    found = jax.vmap(one)(waves, rate, torque, speed, end)
    return found.q[:, -1, 0], found.stats["num_switches"]


def turned(waves, rate, torque, speed, end):
    """Returns the last angle and the number of switches, one half wave at a time."""
    t = q = 0.0
    count = 0
    while True:
        torque_now = torque * (-1) ** count
        if waves:
            grown = np.sqrt(speed**2 + 2 * torque_now * np.pi / waves)
            length = (grown - speed) / torque_now
        else:
            length = np.pi / rate
        part = min(length, end - t)
        q += speed * part + torque_now * part**2 / 2
        if t + length > end:
            return q, count
        t, speed, count = t + length, speed + torque_now * length, count + 1


def check_turning(*cases):
    # One program serves all tests.
    cases = [np.resize(row, 72).astype(float) for row in cases]
    angles, counts = turning(*cases)
    exact, expected = zip(*(turned(*case) for case in zip(*cases)))
    assert counts.tolist() == list(expected)
    np.testing.assert_allclose(angles, exact, atol=1e-8)


@pytest.mark.slow
def test_random_fast_switching():
    rng = np.random.default_rng(0)
    angular = np.arange(72) % 2
    check_turning(
        angular * rng.integers(1, 25, 72), (1 - angular) * 10 ** rng.uniform(1, 3, 72),
        rng.uniform(0.05, 0.5, 72), rng.uniform(2, 10, 72), rng.uniform(0.5, 2, 72),
    )  # fmt: skip


class Hump(fj.Element):
    """A round bumper of 0.1 m at 2 m, whose force is a `switch` without a jump."""

    aside: fj.Values = fj.field((), unit="m")

    def __call__(self, t, q, qd, linkage):
        distance = jnp.sqrt((q - 2) ** 2 + self.aside**2)
        depth = 0.1 - distance
        push = 100 * depth * (q - 2) / distance
        return fj.forces.switch(depth, push, 0.0, continuous=True)


@pytest.mark.slow
def test_variational_equations_pass_over_nothing():
    """The derivative of the last position in the distance from the line."""
    start, ts = fj.State(jnp.zeros(1), jnp.array([3.7])), jnp.array([0, 4.7 / 3.7])

    def end(z):
        forward = diffrax.ForwardMode()
        found = fj.simulate(SLIDE, start, ts, (Hump(z[0]),), adjoint=forward)
        return found.q[-1]

    varied = lambda z: fj.simulation.sensitivities(
        lambda z: fj.Scene(SLIDE, start, (Hump(z[0]),), ts[-1]),
        lambda scene, motion: motion.q[-1], z, ts,
    )  # fmt: skip
    place = jnp.array([0.01])
    exact = integrated(0.01, 0.1, 3.7, 100.0, 4.7 / 3.7)
    around = [integrated(0.01 + h, 0.1, 3.7, 100.0, 4.7 / 3.7) for h in (1e-3, -1e-3)]
    slope = (around[0] - around[1]) / 2e-3
    found = jax.jit(varied, **LOOPS)(place)
    np.testing.assert_allclose(found.residuals, exact, atol=1e-5)
    np.testing.assert_allclose(found.jacobian[0, 0], slope, rtol=1e-2)
    forward, last = jacobian(end)(place)
    np.testing.assert_allclose(last, exact, atol=1e-8)
    np.testing.assert_allclose(forward[0, 0], slope, rtol=1e-3)


class Tick(fj.Element):
    """A force for a millisecond, which no sample of a longer step sees."""

    def __call__(self, t, q, qd, linkage):
        on = (t > 0.7) & (t < 0.701)
        return fj.forces.switch(jnp.where(on, 1.0, -1.0), 100.0, 0.0) * jnp.ones(1)


@pytest.mark.slow
def test_a_longest_step_sees_what_is_brief():
    start = fj.State([0], [0])
    found = fj.simulate(SLIDE, start, [0, 1.0], (Tick(),), max_step=2e-3)
    assert found.stats["num_steps"] >= 500
    np.testing.assert_allclose(found.qd[-1], 0.1, atol=1e-9)
    with pytest.raises(ValueError, match=r"max_step: expected .*, got 0"):
        fj.simulate(SLIDE, start, [0, 1.0], max_step=0)
    with pytest.raises(ValueError, match="max_step: expected none beside a stepsize"):
        fj.simulate(
            SLIDE, start, [0, 1], max_step=1, stepsize_controller=diffrax.PIDController(
                rtol=1e-6, atol=1e-6
            ),
        )  # fmt: skip


@pytest.mark.slow
def test_where_a_step_ends_is_measured_by_the_motion():
    """A step that is tried over a cushion's edge may go on for 50 km.

    The edge, at 0, was passed by parts of these, and each passage added energy.
    """

    def cushion(t, q, qd, linkage):
        return fj.forces.switch(q, 0.0, 2 * 9.81)

    ball = SLIDE.replace(gravity=9.81, base_angle=0.0)
    period = 4 * np.sqrt(2 * 10 / 9.81)
    start = fj.State([10.0], [0.0])
    motion = fj.simulate(ball, start, np.arange(21) * period, (cushion,))
    np.testing.assert_allclose(motion.q[:, 0], 10, rtol=5e-9)
    assert motion.stats["num_switches"] == 40
