"""States that jump: closed forms, HardStops as the same law, derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS, hessian, jacobian
from scipy.integrate import solve_ivp
from test_conditions import BAR, FORWARD, HANGS, MASS, height, quarter

import fdof_jax as fj
from fdof_jax.forces import HardStops, Reset, switch
from fdof_jax.simulation import Until


def bounce(restitution):
    return Reset(height, lambda t, q, qd, linkage: (q, -restitution * qd), -1)


@pytest.mark.slow
def test_a_ball_that_is_reset_bounces_as_on_a_stop():
    """The two have the same law, and the same energy taken."""
    ts = np.linspace(0, 3, 13)
    start = fj.State([1.0], [0.0])
    found = fj.simulate(MASS, start, ts, (bounce(0.8),))
    stop = HardStops(0, np.inf, restitution=0.8)
    expected = fj.simulate(MASS, start, ts, (stop,))
    np.testing.assert_allclose(found.q, expected.q, atol=1e-12)
    np.testing.assert_allclose(found.qd, expected.qd, atol=1e-12)
    np.testing.assert_allclose(found.taken, expected.taken, atol=1e-12)
    table = found.events.table
    assert table["event"].tolist() == ["is reset"] * 6 and not table["joint"].any()
    np.testing.assert_allclose(table["t [s]"], expected.events.table["t [s]"])


@pytest.mark.slow
def test_thirty_elastic_jumps_keep_the_energy():
    """And their times, which are multiples of that of the first fall."""
    fall = np.sqrt(2 * 10 / 9.81)
    ts = [0, 61.5 * fall]
    motion = fj.simulate(MASS, fj.State([10.0], [0.0]), ts, (bounce(1.0),))
    times = motion.events.table["t [s]"]
    np.testing.assert_allclose(times, fall * (1 + 2 * np.arange(31)), rtol=1e-10)
    np.testing.assert_allclose(motion.taken[-1], 0, atol=1e-9)


def after_twenty_blows(x, blow, **options):
    """Returns the state 0.2 s after the twentieth blow, the energy taken, its time."""
    q0, gravity, restitution = x
    arm, start = MASS.replace(gravity=gravity), fj.State(q0[None], jnp.zeros(1))
    forces = (blow(restitution),)
    motion = fj.simulate(arm, start, [0, 11.3], forces, **options)
    return jnp.hstack(
        [motion.q[-1], motion.qd[-1], motion.taken[-1], motion.events.t[19]]
    )


@pytest.mark.slow
def test_twenty_blows_have_the_derivatives_of_those_on_a_stop():
    x = jnp.array([1.0, 9.81, 0.95])
    stop = lambda restitution: HardStops(0, np.inf, restitution=restitution)
    forward = jacobian(partial(after_twenty_blows, blow=bounce, **FORWARD))
    of_stop = jacobian(partial(after_twenty_blows, blow=stop, **FORWARD))
    reverse = jax.jit(jax.jacrev(partial(after_twenty_blows, blow=bounce)), **LOOPS)
    (found, state), (expected, wanted) = forward(x), of_stop(x)
    np.testing.assert_allclose(state, wanted, rtol=0, atol=1e-9)
    size = np.linalg.norm(expected, axis=1, keepdims=True)
    for slopes in (found, reverse(x)):
        np.testing.assert_allclose(slopes / size, expected / size, rtol=0, atol=1e-9)


def after_jumps(x, **options):
    """Returns a state after jumps of position and velocity, all in its numbers."""
    q0, gravity, kept, lift, level = x
    when = lambda t, q, qd, linkage: q[0] - level
    then = lambda t, q, qd, linkage: (q + lift, -kept * qd + 0.1 * t)
    arm, start = MASS.replace(gravity=gravity), fj.State(q0[None], jnp.zeros(1))
    forces = (Reset(when, then, -1), fj.JointDamper(0.2))
    motion = fj.simulate(arm, start, [0, 1.7], forces, **options)
    return jnp.stack([motion.q[-1, 0], motion.qd[-1, 0], motion.events.t[1]])


@pytest.mark.slow
def test_derivatives_include_the_times_of_jumps():
    x = jnp.array([1.0, 9.81, 0.7, 0.05, 0.1])
    of_all = hessian(partial(after_jumps, **FORWARD))
    curves, forward, _ = of_all(x)
    reverse = jax.jit(jax.jacrev(after_jumps), **LOOPS)(x)
    value = lambda x: of_all(x)[2]
    steps = 1e-5 * np.eye(5)
    difference = [(value(x + h) - value(x - h)) / 2e-5 for h in steps]
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes, np.transpose(difference), atol=1e-7)
    of = lambda q0: of_all(x.at[0].set(q0))[1]
    difference = (of(1 + 1e-4) - of(1 - 1e-4)) / 2e-4
    np.testing.assert_allclose(curves[..., 0], difference, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_ball_bounces_on_a_table_that_rises():
    """As on one at rest, seen from there; so the condition depends on time itself."""

    def bounced(x):
        height, rise, restitution = x
        above = lambda t, q, qd, linkage: q[0] - rise * t
        thrown = lambda t, q, qd, linkage: (q, rise - restitution * (qd - rise))
        start = fj.State(height[None], jnp.zeros(1))
        motion = fj.simulate(
            MASS, start, [0, 0.6], (Reset(above, thrown, -1),), **FORWARD
        )
        return jnp.stack([motion.q[-1, 0], motion.qd[-1, 0], motion.events.t[0]])

    def exact(x):
        height, rise, restitution = x
        speed = jnp.sqrt(rise**2 + 2 * 9.81 * height)
        blow, back = (speed - rise) / 9.81, restitution * speed
        since = 0.6 - blow
        q = rise * 0.6 + back * since - 9.81 * since**2 / 2
        return jnp.stack([q, rise + back - 9.81 * since, blow])

    x = jnp.array([1.0, 0.5, 0.6])
    curves, slopes, values = hessian(bounced)(x)
    np.testing.assert_allclose(values, exact(x), atol=1e-12)
    np.testing.assert_allclose(slopes, jax.jacfwd(exact)(x), atol=1e-9)
    np.testing.assert_allclose(curves, jax.hessian(exact)(x), atol=1e-8)


@pytest.mark.slow
def test_a_rimless_wheel_has_the_multiplier_of_its_return_map():
    """A spoke of 1 m with all mass at the hub; each foot leaves cos(2 a) of its speed.

    So is its square, whose changes on the way do not depend on it, cos(2 a)^2.
    """
    half, slope, gravity = 0.3, 0.08, 9.81
    spoke = fj.Linkage(
        "R", length=[0, 1], com=[[1, 0]], mass=[1], inertia=[0], gravity=gravity
    )
    last = np.pi / 2 - slope - half  # where the next foot comes down
    kept = np.cos(2 * half)
    foot = Reset(
        lambda t, q, qd, linkage: q[0] - last,
        lambda t, q, qd, linkage: (q + 2 * half, kept * qd),
        direction=-1,
    )
    middle = np.pi / 2 - slope
    done = fj.simulation.Until(lambda t, q, qd, linkage: q[0] - middle, -1)

    def from_middle(speed):
        """From one passage of the middle to the next, with a foot in between."""
        start = fj.State(jnp.array([middle]), speed[None])
        ends = fj.simulate(spoke, start, [0, 9.0], (foot,), until=done, **FORWARD)
        return ends.end.qd[0]

    down = 2 * gravity * (np.sin(middle) - np.sin(last))
    up = 2 * gravity * (np.sin(middle) - np.sin(last + 2 * half))
    rest = -np.sqrt((kept**2 * down - up) / (1 - kept**2))
    value, slope_of = jax.jit(
        lambda w: jax.jvp(from_middle, (w,), (jnp.ones_like(w),)), **LOOPS
    )(rest)
    np.testing.assert_allclose(value, rest, rtol=1e-9)
    np.testing.assert_allclose(slope_of, kept**2, rtol=1e-8)


def pinned(x, **options):
    """Returns when a string of 1 m hangs: from then on a pin shortens or frees it.

    The bob keeps its velocity there, so that a shorter string turns faster.
    """
    short, angle = x
    side = lambda t, q, qd, linkage: q[0] - HANGS
    turn = lambda t, q, qd, linkage: (q, qd * jnp.where(qd > 0, 1 / short, short))

    def pull(t, q, qd, linkage):
        shorter = -(1 / short - 1) * linkage.gravity * jnp.cos(q)
        return switch(side(t, q, qd, linkage), shorter, 0 * q, continuous=True)

    string = fj.Linkage("R", length=[0, 1], com=[[1, 0]], mass=[1], inertia=[0])
    start = fj.State((HANGS - angle)[None], jnp.zeros(1))
    forces = Reset(side, turn), pull
    return fj.simulate(string, start, [0, 8.2], forces, **options).events.t[:9]


def pinned_exactly(x):
    short, angle = x
    half = jnp.sin(angle / 2) ** 2
    of = lambda length: 2 * jnp.sqrt(length / 9.81) * quarter(half / length)
    phases = jnp.stack([of(1.0), of(short)])[jnp.arange(9) % 2]
    return jnp.cumsum(phases.at[0].divide(2))


@pytest.mark.slow
def test_a_string_meets_a_pin_nine_times():
    x = jnp.array([0.6, 0.8])
    forward, times = jacobian(partial(pinned, **FORWARD))(x)
    reverse = jax.jit(jax.jacrev(pinned), **LOOPS)(x)
    np.testing.assert_allclose(times, pinned_exactly(x), rtol=0, atol=1e-9)
    exact = jax.jacfwd(pinned_exactly)(x)
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes, exact, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_pendulum_that_is_kicked_is_that_of_scipy():
    kick = Reset(
        lambda t, q, qd, linkage: q[0] - HANGS,
        lambda t, q, qd, linkage: (q, qd + 0.2 * jnp.sign(qd)),
    )
    rates = lambda t, y: [y[1], -1.5 * 9.81 * np.cos(y[0]) - 3 * 0.1 * y[1]]
    passes = lambda t, y: y[0] - HANGS
    passes.terminal = True
    t, y = 0.0, np.array([-0.6, 0.0])
    tolerances = dict(rtol=1e-12, atol=1e-12, method="DOP853")
    while t < 6:
        found = solve_ivp(rates, (t, 6), y, events=passes, **tolerances)
        t, y = found.t[-1], found.y[:, -1]
        if found.status == 1:
            y[1] += 0.2 * np.sign(y[1])
            y[0] += 1e-9 * np.sign(y[1])  # off the zero
    forces = (kick, fj.JointDamper(0.1))
    motion = fj.simulate(BAR, fj.State([-0.6], [0.0]), [0, 6.0], forces)
    np.testing.assert_allclose([motion.q[-1, 0], motion.qd[-1, 0]], y, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.0, 0.02, 0.1, 0.5, 0.8])
def test_jumps_that_follow_each_other_ever_faster_are_named(restitution):
    """Of a ball that comes to rest, after a time that its restitution gives."""
    switches = lambda t, q, qd, linkage: fj.forces.switch(q[0] - 0.9, 0 * q, 0 * q)
    forces = (bounce(jnp.array(restitution)), switches)
    scene = MASS, fj.State([1.0], [0.0]), [0, 9.0], forces
    motion = fj.simulate(*scene, throw=False)
    assert motion.outcome == "too many switches"
    rests = np.sqrt(2 / 9.81) * (1 + restitution) / (1 - restitution)
    np.testing.assert_allclose(motion.stats["time_reached"], rests, rtol=1e-5)
    with pytest.raises(RuntimeError, match=r"is reset\. forces\[0\] \(Reset\)"):
        fj.simulate(*scene)


FLAT = MASS.replace(gravity=0)


@pytest.mark.slow
def test_where_a_reset_leaves_its_condition():
    """On its zero, beyond it, or before it, from where it comes again."""

    def moved(start, shift, factor):
        jumps = Reset(height, lambda t, q, qd, linkage: (q + shift, factor * qd))
        start = fj.State([start], [1.0])
        return fj.simulate(FLAT, start, [0, 1.0], (jumps,), throw=False)

    for start, shift, factor, end in [
        (0.0, 0.0, -1.0, 1.0),  # it starts on the zero
        (-0.5, 0.0, -1.0, -0.5),
        (-0.5, 0.0, 2.0, 1.0),  # it goes on
        (-0.5, 0.3, 1.0, 0.8),
        (-0.5, -0.3, 1.0, -0.1),  # and twice
    ]:
        np.testing.assert_allclose(
            moved(start, shift, factor).q[-1, 0], end, atol=1e-12
        )
    assert moved(-0.5, -1e-9, 1.0).outcome == "too many switches"


@pytest.mark.slow
def test_a_jump_over_another_condition_is_one_there():
    """At once: a reset over another's zero, and a bounce."""
    lifts = Reset(height, lambda t, q, qd, linkage: (q + 2, 0 * qd), -1)
    over = lambda t, q, qd, linkage: q[0] - 1.5
    pushes = Reset(over, lambda t, q, qd, linkage: (q, qd + 1), 1)
    start, fall = fj.State([1.0], [0.0]), np.sqrt(2 / 9.81)
    motion = fj.simulate(MASS, start, [0, 0.5], (lifts, pushes))
    np.testing.assert_allclose(motion.events.table["t [s]"], [fall, fall], rtol=1e-12)
    after = 0.5 - fall
    np.testing.assert_allclose(motion.qd[-1, 0], 1 - 9.81 * after, rtol=1e-11)
    fast = lambda t, q, qd, linkage: qd[0] - 1
    rests = Reset(fast, lambda t, q, qd, linkage: (q, 0 * qd), 1)
    forces = (HardStops(0, np.inf, restitution=0.5), rests)
    motion = fj.simulate(MASS, start, [0, 0.6], forces)
    assert motion.events.table["event"][:2].tolist() == ["bounces", "is reset"]
    np.testing.assert_allclose(motion.q[-1], 0, atol=1e-12)


@pytest.mark.slow
def test_members_of_a_batch_jump_by_themselves():
    speeds = jnp.array([0.0, 30.0, jnp.nan])
    start = fj.State(jnp.ones((3, 1)), speeds[:, None])
    forces = (bounce(0.5),)
    one = lambda start: fj.simulate(MASS, start, [0, 0.8], forces, throw=False)
    motions = jax.jit(jax.vmap(one), **LOOPS)(start)
    assert motions.outcome.tolist() == ["successful", "successful", "not finite"]
    assert motions.events.count.tolist() == [1, 0, 0]
    fall = np.sqrt(2 / 9.81)
    after = 0.8 - fall
    rise = 9.81 * (0.5 * fall * after - after**2 / 2)
    np.testing.assert_allclose(motions.q[0, 1], rise, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(floor=np.nan), r"forces\[0\] is not finite"),
        (dict(low=np.nan), r"effort of forces\[1\] is not finite"),
        (dict(kept=np.nan), "new values are"),
        (dict(lift=9.0), "beyond a hard stop"),
    ],
)
def test_functions_that_return_what_cannot_be_are_named(wrong, words):
    def motion(floor=0.0, low=-9.0, kept=-0.5, lift=0.0):
        jumps = Reset(
            lambda t, q, qd, linkage: q[0] - floor,
            lambda t, q, qd, linkage: (q + lift, kept * qd),
        )
        ends = Until(lambda t, q, qd, linkage: q[0] - low)
        forces = jumps, ends, HardStops(-np.inf, 2.0)
        return fj.simulate(MASS, fj.State([1.0], [0.0]), [0, 0.7], forces)

    assert motion().events.count == 1
    with pytest.raises(RuntimeError, match=words):
        motion(**wrong)
