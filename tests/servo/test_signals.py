"""Steps, pulses and ramps of a reference, against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import FORWARD, SLIDE
from helpers import Push
from jax.flatten_util import ravel_pytree
from modes import ADJOINT, LOOPS, jacobian

import fdof_jax as fj

TS = np.linspace(-0.55, 2.0, 26)  # none at a jump, where differences are none
W = 10.0  # of the loop, critically damped [rad/s]


def after_step(t):
    """Returns the response to a step of 1 m at 0 s."""
    t = np.maximum(t, 0)
    return 1 - (1 + W * t) * np.exp(-W * t)


def after_kink(t):
    """Returns the response to a reference that moves at 1 m/s from 0 s on."""
    t = np.maximum(t, 0)
    return t - t * np.exp(-W * t)


def of_step(before, after, begin):
    return before + (after - before) * after_step(TS - begin)


def of_pulse(outside, inside, begin, end):
    pulse = after_step(TS - begin) - after_step(TS - end)
    return outside + (inside - outside) * pulse


def of_ramp(ts, q):
    kinks = np.diff(np.diff(q[:, 0]) / np.diff(ts), prepend=0, append=0)
    return q[0, 0] + sum(kink * after_kink(TS - t) for t, kink in zip(ts, kinks))


TIMES, PLACES = np.array([0.1, 0.43, 1.07]), np.array([[0.3], [0.1], [0.8]])
STEP = fj.references.Step(0.3, [0.7], begin=0.25)
PULSE = fj.references.Pulse(0.3, 0.7, begin=0.31, end=0.61)
RAMP = fj.references.Ramp(TIMES, PLACES)


class Sum(fj.references.Reference):
    """References together, to whose sum a loop answers by the sum of its answers."""

    parts: tuple

    def __call__(self, t, linkage):
        return jax.tree.map(lambda *q: sum(q), *(of(t, linkage) for of in self.parts))

    @property
    def jump_ts(self):
        return jnp.concatenate([part.jump_ts for part in self.parts])


def places(parts, **options):
    reference = Sum(parts)
    pd = fj.PDController(W**2, 2 * W, np.inf, reference)
    start, _ = reference(TS[0], SLIDE)
    return fj.simulate(SLIDE, fj.State(start, 0 * start), TS, (pd,), **options).q[:, 0]


@pytest.mark.slow
def test_a_loop_answers_as_closed_forms_say():
    numbers, whole = ravel_pytree((STEP, PULSE, RAMP))

    def right(x):
        rows = zip((of_step, of_pulse, of_ramp), whole(x))
        return sum(np.squeeze(of(*jax.tree.leaves(part))) for of, part in rows)

    found, q = jacobian(lambda x: places(whole(x), **FORWARD))(numbers)
    np.testing.assert_allclose(q, right(numbers), atol=1e-8)
    h = 1e-5
    steps = h * np.eye(numbers.size)
    wanted = [(right(numbers + row) - right(numbers - row)) / (2 * h) for row in steps]
    np.testing.assert_allclose(found, np.transpose(wanted), atol=1e-6)
    # In reverse mode, in several times and places
    last, ramp = ravel_pytree(RAMP)
    of_ramp_alone = lambda x: places((STEP, PULSE, ramp(x)))
    back = jax.jit(jax.jacrev(of_ramp_alone), **LOOPS)(last)
    np.testing.assert_allclose(back, found[:, -last.size :], atol=1e-7)


def test_a_step_is_at_0_s_by_default():
    step = fj.references.Step(0.3, 0.7)
    places = [float(step(t, SLIDE)[0][0]) for t in (-1, -1e-9, 0, 1)]
    assert places == [0.3, 0.3, 0.7, 0.7]


def test_ramps_stand_before_and_after_their_times():
    ramp = fj.references.Ramp([0, 1, 3], [[0, 1], [1, 1], [1, -1]])
    arm = fj.scenes.double_pendulum().linkage
    rows = {
        -1: ([0, 1], [0, 0]), 0: ([0, 1], [1, 0]), 1: ([1, 1], [0, -1]),
        2: ([1, 0], [0, -1]), 3: ([1, -1], [0, 0]), 9: ([1, -1], [0, 0]),
    }  # fmt: skip
    for t, right in rows.items():
        np.testing.assert_allclose(ramp(t, arm), right, atol=1e-12)


# Jumps that throw a controller past its limit, at once


def motor(reference, kp=100.0, kd=0.0, limit=10.0):
    return fj.PDController([kp], [kd], limit, reference)


def place(*forces, speed=0.0, end=0.5, **options):
    """Returns where a slide is that starts at 0 m."""
    start = fj.State([0.0], [speed])
    return fj.simulate(SLIDE, start, [0, end], forces, **options).q[-1, 0]


def step_at(begin):
    return motor(fj.references.Step([0.0], [1.0], begin=begin))


def saturating(begin, **options):
    """10 N have pushed since the step: a closed form."""
    return place(step_at(begin), **options)


def pulse(end, begin=0.1, kd=1.0):
    """A pulse saturates a controller on both of its sides."""
    return motor(fj.references.Pulse([0.0], [1.0], begin=begin, end=end), kd=kd)


@pytest.mark.slow
def test_the_times_of_jumps_past_a_limit_have_derivatives_beside_the_motion():
    """A jump past a limit is a kink that the controller passes at once."""
    start, ts = fj.State([0.0], [0.0]), jnp.array([0.0, 0.5])
    scene_at = lambda z: fj.Scene(SLIDE, start, (pulse(z[1], z[0], 0.0),), 0.5)
    end = lambda z: fj.simulate(scene_at(z), ts).q[-1, 0]
    last = lambda _, motion: motion.q[-1]
    varied = lambda z: fj.simulation.sensitivities(scene_at, last, z, ts)
    beside = jax.jit(varied, **LOOPS)
    for times in ([0.1, 9.0], [0.2, 9.0], [0.05, 0.1], [0.05, 0.2]):
        z = jnp.array(times)
        slopes = [(end(z + h) - end(z - h)) / 2e-5 for h in 1e-5 * np.eye(2)]
        np.testing.assert_allclose(beside(z).jacobian[0], slopes, rtol=1e-4, atol=1e-9)


def forward(begin):
    """Returns the value and the derivative."""
    return jax.jvp(functools.partial(saturating, **FORWARD), (begin,), (1.0,))


@pytest.mark.slow
@pytest.mark.parametrize("first", [forward, jax.value_and_grad(saturating)])
def test_they_have_them_in_all_modes(first):
    """First derivatives forward and by tangents, and second ones over them."""
    twice = lambda begin: jax.jvp(first, (begin,), (1.0,))
    both = jax.jit(twice, **LOOPS)
    for begin in (0.1, 0.2, 0.3):
        (value, slope), (_, curvature) = both(begin)
        left = 0.5 - begin
        np.testing.assert_allclose(value, 5 * left**2)
        np.testing.assert_allclose([slope, curvature], [-10 * left, 10], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("order, options", [(1, {}), (-1, dict(adjoint=ADJOINT))])
def test_each_of_two_jumps_at_one_time_has_its_own_derivative(order, options):
    """Also where one of them passes a limit at once, whichever is listed first."""
    forces = lambda begins: (Push(begins[0], 3.0), step_at(begins[1]))[::order]
    end = lambda begins: place(*forces(begins), **options)
    slopes = jax.jit(jax.grad(end), **LOOPS)
    for later in (0.0, 2e-15, 1e-12):  # a few units of rounding, and many
        found = slopes(jnp.array([0.3, 0.3 + later]))
        np.testing.assert_allclose(found, [-3 * 0.2, -10 * 0.2], rtol=1e-9)


def blow(begin):
    """A payload slows the slide, so that its motor saturates."""
    load = fj.forces.Payload(fj.Point(1, 0.0), mass=1.0, begin=begin)
    return motor(fj.references.SetPoint(0.0, 1.0), 0.0, 100.0, 1.0), load


@pytest.mark.slow
@pytest.mark.parametrize("end", [
    lambda begin: place(*blow(begin), speed=1.0),
    lambda end: place(pulse(end), end=1.0),
], ids=["blow", "pulse"])  # fmt: skip
def test_what_a_blow_or_a_pulse_saturates_has_derivatives(end):
    h, both = 1e-4, jax.jit(jax.value_and_grad(end), **LOOPS)
    value = lambda begin: both(begin)[0]
    one, two = (value(0.3 + k * h) - value(0.3 - k * h) for k in (1, 2))
    np.testing.assert_allclose(both(0.3)[1], (8 * one - two) / (12 * h), rtol=1e-6)
