"""Motions that end where a condition is met: closed forms, derivatives."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS, hessian, jacobian
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import fdof_jax as fj
from fdof_jax.simulation import Until

MASS = fj.Linkage(
    "P", length=[0, 0], com=[[0, 0]], mass=[1], inertia=[1], base_angle=0
)  # upwards
BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
HANGS = -np.pi / 2  # the angle of a bar that hangs
FORWARD = dict(adjoint=diffrax.ForwardMode())


def height(t, q, qd, linkage):
    return q[0]


def fall(x, floor=None, **options):
    """Returns the end of a fall from a height to another, thrown upwards."""
    q0, qd0, gravity, last = x
    floor = last if floor is None else floor
    above = lambda t, q, qd, linkage: q[0] - floor
    start = fj.State(jnp.stack([q0]), jnp.stack([qd0]))
    arm = MASS.replace(gravity=gravity)
    motion = fj.simulate(arm, start, [0, 1, 2.0, 9.0], until=above, **options)
    return jnp.stack([motion.end.t, motion.end.q[0], motion.end.qd[0]])


def fallen(x):
    q0, qd0, gravity, floor = x
    fast = jnp.sqrt(qd0**2 + 2 * gravity * (q0 - floor))
    return jnp.stack([(qd0 + fast) / gravity, floor, -fast])


@pytest.mark.slow
def test_a_fall_ends_on_the_floor():
    """With first and second derivatives in all numbers, the condition's own too."""
    x = jnp.array([10.0, 1.0, 9.81, 0.3])
    forward, values = jacobian(partial(fall, **FORWARD))(x)
    reverse = jax.jit(jax.jacrev(fall), **LOOPS)(x)
    np.testing.assert_allclose(values, fallen(x), rtol=1e-12)
    exact = jax.jacfwd(fallen)
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes, exact(x), rtol=1e-10, atol=1e-12)
    on_floor = lambda x: fall(jnp.append(x, 0.3), floor=0.3, **FORWARD)
    curves, *_ = hessian(on_floor)(x[:3])
    np.testing.assert_allclose(curves, jax.jacfwd(exact)(x)[:, :3, :3], atol=1e-10)


@pytest.mark.slow
def test_rows_after_the_end_are_not_there():
    motion = fj.simulate(MASS, fj.State([10.0], [1.0]), [0, 1, 2.0], until=height)
    assert bool(motion.ended) and motion.outcome == "ended"
    assert motion.result == diffrax.RESULTS.successful
    assert np.isfinite(motion.q[:2]).all() and np.isnan(motion.q[2:]).all()
    np.testing.assert_allclose(motion.stats["time_reached"], motion.end.t)
    assert "ended" in repr(motion)
    free = fj.simulate(MASS, fj.State([10.0], [1.0]), [0, 1.0], until=height)
    assert not free.ended and free.outcome == "successful"
    np.testing.assert_array_equal(free.end.q, free.q[-1])
    assert (free.end.t, free.end.condition) == (1, -1)


def quarter(sine2):
    """Returns the complete elliptic integral K, by the mean of Gauss."""
    a, b = 1.0, jnp.sqrt(1 - sine2)
    for _ in range(6):
        a, b = (a + b) / 2, jnp.sqrt(a * b)
    return np.pi / 2 / a


def lowest(x, **options):
    """Returns time, angle and rate of a bar at its lowest point, from rest."""
    gravity, mass, q0 = x
    bar = BAR.replace(gravity=gravity, mass=mass[None])
    there = lambda t, q, qd, linkage: q[0] - HANGS
    start = fj.State(q0[None], jnp.zeros(1))
    *end, _ = fj.simulate(bar, start, [0, 9.0], until=there, **options).end
    return jnp.hstack(end)


def lowest_exactly(x):
    gravity, mass, q0 = x
    moment, inertia = mass * gravity / 2, 1 / 12 + mass / 4
    time = jnp.sqrt(inertia / moment) * quarter(jnp.sin((q0 - HANGS) / 2) ** 2)
    rate = -jnp.sqrt(2 * moment / inertia * (1 + jnp.sin(q0)))
    return jnp.stack([time, jnp.full_like(time, HANGS), rate])


@pytest.mark.slow
def test_a_bar_comes_to_its_lowest_point_in_the_time_of_an_elliptic_integral():
    """With first and second derivatives in gravity, its mass and the first angle."""
    x = jnp.array([9.81, 1.3, 0.0])  # from level
    at_level = np.sqrt((1 / 12 + 1.3 / 4) / (1.3 * 9.81 / 2)) * ellipk(1 / 2)
    np.testing.assert_allclose(lowest_exactly(x)[0], at_level, rtol=1e-15)
    curves, forward, values = hessian(partial(lowest, **FORWARD))(x)
    reverse = jax.jit(jax.jacrev(lowest), **LOOPS)(x)
    np.testing.assert_allclose(values, lowest_exactly(x), rtol=0, atol=1e-11)
    exact = jax.jacfwd(lowest_exactly)
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes, exact(x), rtol=0, atol=1e-10)
    np.testing.assert_allclose(curves, jax.jacfwd(exact)(x), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_thousand_members_of_a_sweep_end_as_each_does_alone():
    rng = np.random.default_rng(0)
    starts = fj.State(rng.uniform(-1.5, 1.5, (1000, 1)), rng.uniform(-3, 3, (1000, 1)))
    there = Until(lambda t, q, qd, linkage: q[0] - HANGS)
    swept = fj.sweep(BAR, starts, [0, 9.0], (there,)).end
    one = jax.jit(lambda start: fj.simulate(BAR, start, [0, 9.0], (there,)).end)
    alone = [one(fj.State(*rows)) for rows in zip(*starts)]
    alone = jax.tree.map(lambda *rows: np.stack(rows), *alone)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-10), swept, alone
    )


@pytest.mark.slow
def test_the_period_of_a_pendulum_and_its_derivative():
    """A bar that starts on the zero returns there, upwards, a period later."""
    returns = Until(lambda t, q, qd, linkage: q[0] - HANGS, direction=1)

    def period(speed):
        start = fj.State(jnp.array([HANGS]), jnp.stack([speed]))
        return fj.simulate(BAR, start, [0, 60.0], until=returns, **FORWARD).end.t

    # Energy: qd^2 / 2 = (3 g / 2 L) (1 - cos a) at the amplitude a.
    squared = lambda speed: speed**2 / (6 * 9.81)  # sin(a / 2)^2
    exact = lambda speed: 4 * ellipk(squared(speed)) / np.sqrt(1.5 * 9.81)
    of = jax.jit(lambda x: jax.jvp(period, (x,), (jnp.ones_like(x),)), **LOOPS)
    for speed in (0.5, 5.0, 7.6):  # over the top at 7.67
        found, slope = of(speed)
        np.testing.assert_allclose(found, exact(speed), rtol=1e-9)
        h = 1e-5 * speed
        difference = (exact(speed + h) - exact(speed - h)) / (2 * h)
        np.testing.assert_allclose(slope, difference, rtol=2e-5)


@pytest.mark.slow
def test_the_end_is_that_of_scipy():
    """A double pendulum with dampers, until its tip crosses a line downwards."""
    arm = fj.scenes.double_pendulum().linkage
    damper = fj.JointDamper(0.3)

    def line(t, q, qd, linkage):
        tip = fj.tip_position(linkage, q)
        return tip[1] + 0.2 * tip[0] + 0.1 * t

    rates = jax.jit(
        lambda t, y: jnp.concatenate(
            [y[2:], fj.forward_dynamics(arm, y[:2], y[2:], -0.3 * y[2:])]
        )
    )
    value = jax.jit(lambda t, y: line(t, y[:2], y[2:], arm))
    crossing = lambda t, y: float(value(t, y))
    crossing.terminal, crossing.direction = True, -1
    tolerances = dict(rtol=1e-12, atol=1e-12, method="DOP853")
    for q0 in ([0.7, 0.4], [1.2, -0.5], [0.2, 1.0]):
        y0 = np.array([*q0, 0.1, -0.2])
        exact = solve_ivp(rates, (0, 20), y0, events=crossing, **tolerances)
        motion = fj.simulate(
            arm, fj.State(y0[:2], y0[2:]), [0, 20.0], (damper,), until=Until(line, -1)
        )
        (time,), (state,) = exact.t_events[0], exact.y_events[0]
        np.testing.assert_allclose(motion.end.t, time, rtol=1e-9)
        found = np.concatenate([motion.end.q, motion.end.qd])
        np.testing.assert_allclose(found, state, atol=1e-8)


@pytest.mark.slow
def test_the_first_of_several_ends_it():
    start = fj.State([10.0], [1.0])
    top = Until(lambda t, q, qd, linkage: qd[0], -1)
    late = lambda t, q, qd, linkage: t - 0.5
    ends = {
        (height, top): 1, (top, height): 0, (height, late): 1,
        (Until(top.condition, 1), height): 1,  # the speed falls through 0
    }  # fmt: skip
    for until, first in ends.items():
        assert fj.simulate(MASS, start, [0, 9.0], until=until).end.condition == first
    at_top = fj.simulate(MASS, start, [0, 9.0], until=top).end
    np.testing.assert_allclose(at_top.t, 1 / 9.81, rtol=1e-12)


@pytest.mark.slow
def test_a_jump_that_carries_a_condition_over_its_zero_ends_the_motion_there():
    """A bounce, with its derivatives, and a payload."""
    rises = Until(lambda t, q, qd, linkage: qd[0] - 1, direction=1)

    def bounced(x, **options):
        q0, gravity, restitution = x
        stop = fj.forces.HardStops(0, jnp.inf, restitution=restitution)
        arm, start = MASS.replace(gravity=gravity), fj.State(q0[None], jnp.zeros(1))
        end = fj.simulate(arm, start, [0, 2.0], (stop,), until=rises, **options).end
        return jnp.stack([end.t, end.q[0], end.qd[0]])

    def exactly(x):
        q0, gravity, restitution = x
        fast = jnp.sqrt(2 * gravity * q0)
        return jnp.stack([fast / gravity, 0 * q0, restitution * fast])

    x = jnp.array([1.0, 9.81, 0.6])
    forward, values = jacobian(partial(bounced, **FORWARD))(x)
    reverse = jax.jit(jax.jacrev(bounced), **LOOPS)(x)
    np.testing.assert_allclose(values, exactly(x), atol=1e-11)
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes, jax.jacfwd(exactly)(x), atol=1e-10)
    load = fj.forces.Payload(fj.Point(1, 1.0), mass=1.5, begin=0.5, end=2.0)
    slows, arm = lambda t, q, qd, linkage: qd[0] - 1, BAR.replace(gravity=0)
    start = fj.State([0.0], [2.0])
    end = fj.simulate(arm, start, [0, 1.0], (load,), until=slows).end
    kept = (1 / 3) / (1 / 3 + 1.5)
    found = [end.t, end.q[0], end.qd[0]]
    np.testing.assert_allclose(found, [0.5, 1, 2 * kept], atol=1e-12)


@pytest.mark.slow
def test_members_of_a_batch_end_by_themselves():
    """One ends, one never does, one fails; in a sweep, too, where it is an element."""
    speeds = jnp.array([1.0, 100.0, jnp.nan, 2.0])
    start = fj.State(jnp.zeros((4, 1)), speeds[:, None])
    one = lambda start: fj.simulate(MASS, start, [0, 9.0], until=height, throw=False)
    motions = jax.jit(jax.vmap(one), **LOOPS)(start)
    outcomes = ["ended", "successful", "not finite", "ended"]
    assert motions.outcome.tolist() == outcomes
    expected = [2 / 9.81, 9, np.nan, 4 / 9.81]
    np.testing.assert_allclose(np.delete(motions.end.t, 2), np.delete(expected, 2))
    swept = fj.sweep(MASS, start, [0, 9.0], (Until(height),))
    assert swept.outcome.tolist() == outcomes
    np.testing.assert_allclose(swept.end.t, motions.end.t, rtol=1e-12)


@pytest.mark.slow
def test_what_holds_joints_and_samples_goes_on_until_the_end():
    stop = fj.forces.HardStops(0, np.inf, restitution=0.5)
    slow = Until(lambda t, q, qd, linkage: q[0] - 0.2, direction=1)
    motion = fj.simulate(MASS, fj.State([1.0], [0.0]), [0, 9.0], (stop,), until=slow)
    fast = np.sqrt(2 * 9.81)
    up = 0.5 * fast
    time = fast / 9.81 + (up - np.sqrt(up**2 - 2 * 9.81 * 0.2)) / 9.81
    np.testing.assert_allclose(motion.end.t, time, rtol=1e-10)
    assert motion.events.count == 1
    push = lambda t, q, qd, linkage: jnp.array([9.81 + 1.0])
    start, until = fj.State([0.0], [0.0]), lambda t, q, qd, linkage: q[0] - 0.5
    sampled = fj.simulate_sampled(MASS, start, push, 0.3, 9, until=until)
    np.testing.assert_allclose(sampled.end.t, 1, rtol=1e-9)
    assert np.isnan(sampled.tau[5:]).all() and np.isfinite(sampled.tau[:4]).all()
