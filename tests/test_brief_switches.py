"""Switches that follow each other within what would be one step."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR, SLIDE
from modes import LOOPS
from scipy.integrate import solve_ivp

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

pytestmark = pytest.mark.slow
ROTOR = BAR.replace(com=[[0, 0]], inertia=[1], gravity=0.0)
PENDULUM = fj.scenes.double_pendulum().linkage
BATCH = dict(solver=LoopedDopri8(), throw=False)


@partial(jax.jit, **LOOPS)
@jax.vmap
def passing(aside, radius, speed, stiffness, end):
    """A slide that passes a round bumper at 2 m, from 0 m on."""
    bumper = fj.SpringDamper(
        fj.Point(0, aside, 2.0), fj.Point(1), stiffness=stiffness, rest_length=radius,
        one_sided="bumper",
    )  # fmt: skip
    start, ts = fj.State(jnp.zeros(1), speed[None]), jnp.stack([0 * end, end])
    return fj.simulate(SLIDE, start, ts, (bumper,), **BATCH)


def integrated(aside, radius, speed, stiffness, end):
    """Returns where SciPy's method ends up in short steps."""

    def rates(t, y):
        along = y[0] - 2
        distance = np.hypot(along, aside)
        push = stiffness * max(radius - distance, 0)
        return [y[1], push * along / distance]

    options = dict(max_step=radius / speed / 10, rtol=1e-10, atol=1e-11)
    return solve_ivp(rates, [0, end], [0, speed], "DOP853", **options).y[0, -1]


def test_no_bumper_is_passed_over():
    """Some are met or missed by little within one step, which would end at 4.7 m."""
    rng = np.random.default_rng(0)
    radius, speed = 10 ** rng.uniform(np.log10(0.003), -1, 20), rng.uniform(1, 3.7, 20)
    aside, stiffness = rng.uniform(-0.95, 0.95, 20) * radius, np.full(20, 10.0)
    end = rng.uniform(2.5, 4.7, 20)
    by_little = np.array([0.01, -0.0029, 0.1 + 1e-6, 0.1 + 1e-3, -0.1 - 1e-6])
    aside[:5], radius[:5], stiffness[:5] = by_little, [0.1, 0.003, 0.1, 0.1, 0.1], 1e3
    speed[:5], end[:5] = [3.7, 1, 3.7, 3.7, 1], [4.7, 2.5, 4.7, 4.7, 4.7]
    cases = aside, radius, speed, stiffness, end / speed
    found = passing(*cases)
    switches, missed = found.stats["num_switches"], found.stats["num_steps"][2:5]
    assert switches[:5].tolist() == [4, 4, 0, 0, 0] and (switches[5:] >= 2).all()
    exact = [integrated(*case) for case in zip(*cases)]
    np.testing.assert_allclose(found.q[:, -1, 0], exact, atol=1e-8)
    assert (missed <= 25).all()  # without the bumper it takes six steps
    share = np.sqrt(1e-6 / 2)  # it passes at 1e-6 m, of the 2 m at which it began
    assert abs(found.stats["slowest_crossing"][2] / share - 1) < 0.1


@partial(jax.jit, **LOOPS)
@partial(jax.vmap, in_axes=(0, 0, 0, 0, None, None, None))
def meeting(q, qd, place, radius, end, tolerance, max_step):
    """A double pendulum whose tip may meet a peg."""
    peg = fj.SpringDamper(
        fj.Point(0, *place), fj.Point(2, 1.0), stiffness=1e3, damping=2,
        rest_length=radius, one_sided="bumper",
    )  # fmt: skip
    options = dict(rtol=tolerance, atol=tolerance, max_step=max_step, max_steps=100_000)
    start, ts = fj.State(q, qd), jnp.stack([0 * end, end])
    return fj.simulate(PENDULUM, start, ts, (peg,), **options, **BATCH)


def test_no_peg_is_passed_over():
    """Against steps much shorter than the pegs, which are where tips are at 0.4 s."""
    rng = np.random.default_rng(5)
    q, qd = rng.uniform(-2, 2, (24, 2)) + [0.5, 0], rng.uniform(-3, 3, (24, 2))
    radius = np.repeat([0.005, 0.02], 12)
    free = meeting(q, qd, np.full((24, 2), 9.0), radius, 0.4, 1e-11, 1.2)
    tips = jax.vmap(partial(fj.tip_position, PENDULUM))(free.q[:, -1])
    place = tips + rng.uniform(-0.6, 0.6, (24, 2)) * radius[:, None]
    move = partial(meeting, q, qd, place, radius, 1.2)
    exact = move(1e-11, 0.005 / 40)
    assert (exact.stats["num_steps"] > 1.2 / 0.005 * 40).all()
    for tolerance, bound in ((1e-11, 1e-9), (1e-6, 1e-4)):
        found = move(tolerance, 1.2)  # the whole motion
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


@partial(jax.jit, **LOOPS)
@jax.vmap
def turning(waves, rate, torque, speed, end):
    start, ts = fj.State(jnp.zeros(1), speed[None]), jnp.stack([0 * end, end])
    return fj.simulate(ROTOR, start, ts, (Cogging(waves, rate, torque),), **BATCH)


def turned(waves, rate, torque, speed, end):
    """Returns the last angle and the number of switches, one half wave at a time."""
    t, q, count = 0.0, 0.0, 0
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


def test_random_fast_switching():
    rng = np.random.default_rng(0)
    angular = np.arange(72) % 2
    waves, rates = rng.integers(1, 25, 72), 10 ** rng.uniform(1, 3, 72)
    cases = (
        1.0 * angular * waves, (1 - angular) * rates,
        rng.uniform(0.05, 0.5, 72), rng.uniform(2, 10, 72), rng.uniform(0.5, 2, 72),
    )  # fmt: skip
    found = turning(*cases)
    angles, switches = zip(*(turned(*case) for case in zip(*cases)))
    assert found.stats["num_switches"].tolist() == list(switches)
    np.testing.assert_allclose(found.q[:, -1, 0], angles, atol=1e-8)


def test_where_a_step_ends_is_measured_by_the_motion():
    """A step that is tried over a cushion's edge, at 0, may go on for 50 km."""
    cushion = lambda t, q, qd, linkage: fj.forces.switch(q, 0.0, 2 * 9.81)
    ball = SLIDE.replace(gravity=9.81, base_angle=0.0)
    period = 4 * np.sqrt(2 * 10 / 9.81)
    start, ts = fj.State([10.0], [0.0]), np.arange(21) * period
    motion = fj.simulate(ball, start, ts, (cushion,))
    np.testing.assert_allclose(motion.q[:, 0], 10, rtol=5e-9)
    assert motion.stats["num_switches"] == 40
