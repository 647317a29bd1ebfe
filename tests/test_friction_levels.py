"""Dry friction whose level depends on the direction and on the state."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS, hessian, jacobian
from scipy.integrate import solve_ivp

import fdof_jax as fj
from fdof_jax.forces import JointFriction, stribeck

SLOPE = 0.3  # rad, of the block's slide
BLOCK = fj.Linkage(
    "P",
    length=[0, 1],
    com=[[0, 0]],
    mass=[1],
    inertia=[1],
    base_angle=SLOPE - np.pi / 2,
)
SLIDE = BLOCK.replace(gravity=0.0)


@pytest.mark.slow
def test_a_block_comes_down_a_slope_by_the_friction_of_that_direction():
    """It goes up against 4 N, turns, and comes down against 1 N; rows are 4, 1."""
    v, (up, down) = 2.0, (4.0, 1.0)
    weight = 9.81 * np.sin(SLOPE)
    friction = (JointFriction([[up], [down]]),)
    ts = np.array([0.0, 0.1, 1.0])
    motion = fj.simulate(BLOCK, fj.State([0.0], [v]), ts, friction)
    top = v / (weight + up)
    height = v**2 / 2 / (weight + up)
    q = [0, v * 0.1 - (weight + up) * 0.1**2 / 2]
    q += [height - (weight - down) * (1 - top) ** 2 / 2]
    np.testing.assert_allclose(motion.q[:, 0], q, rtol=0, atol=1e-9)
    taken = [0, up * q[1], up * height + down * (height - q[2])]
    np.testing.assert_allclose(motion.taken, taken, rtol=0, atol=1e-9)
    effort = fj.joint_efforts(BLOCK, friction, motion).total[:, 0]
    np.testing.assert_allclose(effort, [-up, -up, down], rtol=0, atol=1e-12)
    # Held on the way down, and taken along by a push uphill of the same size.
    held = JointFriction([[1.0], [weight + 0.1]])
    assert fj.simulate(BLOCK, fj.State([0.0], [0.0]), ts, (held,)).q[-1, 0] == 0
    push = fj.JointEffort([2 * weight])
    motion = fj.simulate(BLOCK, fj.State([0.0], [0.0]), ts, (held, push))
    np.testing.assert_allclose(motion.q[-1, 0], (weight - 1) / 2, atol=1e-9)


@pytest.mark.slow
def test_friction_in_one_direction_alone_lets_the_other_one_go():
    pull = lambda t, q, qd, linkage: jnp.maximum(t - 0.5, 0) * jnp.ones(1)
    free, held = JointFriction([[0.0], [3.0]]), JointFriction([[3.0], [0.0]])
    start, ts = fj.State([0.0], [0.0]), [0, 2.0]
    motion = fj.simulate(SLIDE, start, ts, (free, pull))
    np.testing.assert_allclose(motion.q[-1, 0], 1.5**3 / 6, rtol=0, atol=1e-9)
    assert fj.simulate(SLIDE, start, ts, (held, pull)).q[-1, 0] == 0


# Levels that are functions

STIFFNESS, PACE = 100.0, 0.1  # N/m, m/s
FRICTION = np.array([2.0, 3.0, 0.05])  # coulomb [N], static [N], speed [m/s]
REST, TS = fj.State([0.0], [0.0]), np.linspace(0, 7.5, 9)  # ten cycles [s]
TIGHT = dict(rtol=1e-12, atol=1e-12)
FORWARD = dict(adjoint=diffrax.ForwardMode())


def drag(t, q, qd, linkage):
    return STIFFNESS * (PACE * t - q)


def dragged(numbers, *forces, **options):
    friction = JointFriction(stribeck(*numbers))
    return fj.simulate(SLIDE, REST, TS, (friction, drag, *forces), **options)


def scipy_times(coulomb, static, speed, end):
    """Returns the times at which the dragged slide slips and sticks, in turn."""

    def rates(t, y):
        fall = (static - coulomb) * np.exp(-((y[1] / speed) ** 2))
        return y[1], STIFFNESS * (PACE * t - y[0]) - coulomb - fall

    rests = lambda t, y: y[1]
    rests.terminal, rests.direction = True, -1
    x, times = 0.0, []
    while (slips := (x + static / STIFFNESS) / PACE) < end:
        found = solve_ivp(
            rates, (slips, slips + 2), (x, 0.0), "DOP853", events=rests,
            rtol=1e-12, atol=1e-14, first_step=1e-6,
        )  # fmt: skip
        x = found.y_events[0][0][0]
        times += [slips, found.t_events[0][0]]
    return np.array(times)


@pytest.mark.slow
def test_a_dragged_slide_sticks_and_slips_as_scipy_has_it():
    motion = dragged(FRICTION, **TIGHT)
    times = scipy_times(*FRICTION, TS[-1])
    assert motion.events.count == len(times) == 20
    np.testing.assert_allclose(motion.events.t[:20], times, rtol=0, atol=1e-9)
    assert (np.asarray(motion.taken) < 1e-20).all()  # functions are not counted

    coulomb, static, speed = FRICTION

    def falls(t, q, qd, linkage):
        missing = (static - coulomb) * (1 - jnp.exp(-((qd / speed) ** 2)))
        return missing * jnp.sign(qd)

    forces = JointFriction(static), drag, falls
    other = fj.simulate(SLIDE, REST, TS, forces, **TIGHT)
    np.testing.assert_allclose(motion.q, other.q, rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.events.t, other.events.t, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_derivatives_of_stick_slip():
    """In both modes they equal differences; in the first times of each kind, too."""

    def result(numbers, **options):
        motion = dragged(numbers, **options, **TIGHT)
        return jnp.append(motion.events.t[:2], motion.q[-1, 0])

    steps = 1e-5 * FRICTION * np.eye(3)
    near = [result(FRICTION + sign * step) for step in steps for sign in (1, -1)]
    wanted = np.stack(near).reshape(3, 2, 3)
    wanted = (wanted[:, 0] - wanted[:, 1]).T / (2e-5 * FRICTION)
    forward = partial(result, adjoint=diffrax.ForwardMode())
    numbers = jnp.asarray(FRICTION)
    found, _ = jacobian(forward)(numbers)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-7)
    found = jax.jit(jax.jacrev(result), **LOOPS)(numbers)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_a_later_slip_has_a_time_with_derivatives_in_what_a_function_holds():
    """A held slide at q slips at (q + static / stiffness) / pace."""
    static = 3.0
    friction = JointFriction(stribeck(2.0, static=static, speed=0.05))

    def slips(numbers):
        stiffness, pace = numbers
        drag = lambda t, q, qd, linkage: stiffness * (pace * t - q)
        motion = fj.simulate(
            SLIDE, REST, [0, 0.9, 1.2], (friction, drag), adjoint=diffrax.ForwardMode()
        )
        return jnp.stack([motion.events.t[2], motion.q[1, 0]])

    (stiffness, pace) = numbers = np.array([100.0, 0.1])
    (of_time, of_place), (time, place) = jacobian(slips)(numbers)
    np.testing.assert_allclose(time, (place + static / stiffness) / pace, rtol=1e-11)
    wanted = (of_place - np.array([static / stiffness**2, time])) / pace
    np.testing.assert_allclose(of_time, wanted, rtol=1e-8)


@pytest.mark.slow
def test_a_clutch_stops_a_slide_by_a_friction_over_time():
    """Of 4 t newtons: 1 kg at 1 m/s, from 0.5 m, stops after sqrt(1/2) s."""
    clutch = lambda t, q, qd, linkage: 4 * t
    motion = fj.simulate(
        SLIDE, fj.State([0.5], [1.0]), [0, 0.5, 2.0], (JointFriction(clutch),)
    )
    time = np.sqrt(0.5)
    q = [0.5, 1 - 2 / 3 * 0.5**3, 0.5 + 2 / 3 * time]
    np.testing.assert_allclose(motion.q[:, 0], q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.events.t[0], time, rtol=0, atol=1e-9)
    assert motion.modes[-1, 0] == 1


class Clutch(fj.Element):
    """A friction of joint 2 that rises with time."""

    pace: fj.Values = fj.field((), unit="N m/s")

    def __call__(self, t, q, qd, linkage):
        return self.pace * t * jnp.array([0.0, 1.0])


def locked(x, **options):
    """Returns when a clutch that closes linearly locks two discs, and their rate."""
    rate, pace, one, two = x
    discs = fj.Linkage(
        "RR", length=[0, 1, 0], com=[[0, 0]] * 2, mass=[1, 0],
        inertia=jnp.stack([one, two]), gravity=0.0,
    )  # fmt: skip
    start = fj.State(jnp.zeros(2), jnp.stack([rate, -rate]))  # disc 2 is at rest
    forces = (JointFriction(Clutch(pace)),)
    motion = fj.simulate(discs, start, [0, 2.0], forces, **options)
    return jnp.stack([motion.events.t[0], motion.qd[-1, 0]])


def locked_exactly(x):
    rate, pace, one, two = x
    both = one * two / (one + two)
    return jnp.stack([jnp.sqrt(2 * rate * both / pace), rate * one / (one + two)])


@pytest.mark.slow
def test_a_clutch_locks_two_discs():
    """With first and second derivatives in the rate, the pace and both inertias."""
    x = jnp.array([3.0, 4.0, 0.5, 0.8])
    curves, forward, values = hessian(partial(locked, **FORWARD))(x)
    reverse = jax.jit(jax.jacrev(locked), **LOOPS)(x)
    np.testing.assert_allclose(values, locked_exactly(x), rtol=0, atol=1e-10)
    exact = jax.jacfwd(locked_exactly)
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes, exact(x), rtol=0, atol=1e-10)
    np.testing.assert_allclose(curves, jax.jacfwd(exact)(x), rtol=0, atol=1e-10)


def test_friction_of_a_function_is_written_to_files(tmp_path):
    friction = JointFriction(stribeck([2.0], 3.0, 0.1), static=[[4.0], [5.0]])
    fj.save(tmp_path / "friction.json", friction)
    assert repr(fj.load(tmp_path / "friction.json")) == repr(friction)


@pytest.mark.slow
@pytest.mark.parametrize(
    "friction",
    [
        JointFriction(lambda t, q, qd, linkage: 1 - 2 * t),
        JointFriction(lambda t, q, qd, linkage: 1 + t, static=1.2),
    ],
)
def test_friction_that_becomes_what_it_cannot_be_ends_a_motion(friction):
    """Negative, or static friction below the level."""
    start = fj.State([0.0], [9.0])
    motion = fj.simulate(SLIDE, start, [0, 1.0], (friction,), throw=False)
    assert motion.outcome == "not finite"
    assert 0.15 < motion.stats["time_reached"] < 0.51
