"""Motions that end or jump where a condition is met: closed forms, derivatives."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.forces import HardStops, Payload, Reset, switch
from fdof_jax.simulation import Until
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

pytestmark = pytest.mark.slow
MASS = fj.Linkage(
    "P", length=[0, 0], com=[[0, 0]], mass=[1], inertia=[1], base_angle=0
)  # upwards
BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
HANGS = -np.pi / 2  # the angle of a bar that hangs


def height(t, q, qd, linkage):
    return q[0]


# What may happen to one joint, by numbers of programs that all cases share: it hits a
# floor; is reset at q = at + rise t, `up` and `down` being factors of its rate; is
# driven by an effort that switches with its rate if `side` is 1; and ends where
# stop_q q + stop_qd qd falls through stop_at, or where q does.
NOTHING = dict(
    q0=0.0, qd0=0.0, gravity=9.81, mass=1.0, t1=9.0, restitution=0.0,
    at=0.0, rise=0.0, lift=0.0, up=1.0, down=1.0, add=0.0, side=0.0, above=0.0,
    below=0.0, stop_q=0.0, stop_qd=0.0, stop_at=-1.0,
)  # fmt: skip


def ends(x):
    return (Until(lambda t, q, qd, linkage: q[0] - x["stop_at"], -1),)


def resets(x):
    when = lambda t, q, qd, linkage: q[0] - x["at"] - x["rise"] * t
    factor = lambda qd: jnp.where(qd > 0, x["up"], x["down"])
    then = lambda t, q, qd, linkage: (q + x["lift"], factor(qd) * qd + x["add"])
    return (Reset(when, then),)


def blows(x):
    push = lambda t, q, qd, linkage: switch(
        qd - 1 + x["side"], x["above"] + 0 * q, x["below"] + 0 * q
    )
    g = lambda t, q, qd, linkage: (
        x["stop_q"] * q[0] + x["stop_qd"] * qd[0] - x["stop_at"]
    )
    return HardStops(0.0, jnp.inf, restitution=x["restitution"]), push, Until(g, -1)


def motion(forces, x, arm, **options):
    arm = arm.replace(gravity=x["gravity"], mass=x["mass"][None])
    start = fj.State(x["q0"][None], x["qd0"][None])
    ts = jnp.stack([0 * x["t1"], x["t1"]])
    found = fj.simulate(arm, start, ts, forces(x), **options)
    if forces is resets:
        return dict(q=found.q[1, 0], qd=found.qd[1, 0], jumps=found.events.t[:20],
                    taken=found.taken[1])  # fmt: skip
    return dict(t=found.end.t, q=found.end.q[0], qd=found.end.qd[0])


def along(function, x, one, *rest):
    """Returns values, and their derivatives along `one`."""
    return jax.jvp(lambda x: function(x, *rest), (x,), (one,))


def twice(function, x, one, *rest):
    """Returns the same, and the derivatives of both along `one`."""
    return along(partial(along, function), x, one, one, *rest)


FORWARD = dict(adjoint=diffrax.ForwardMode())
of_ends = jax.jit(partial(twice, partial(motion, ends, **FORWARD)), **LOOPS)
of_blows = jax.jit(partial(along, partial(motion, blows, **FORWARD)), **LOOPS)


@partial(jax.jit, **LOOPS)
def of_resets(x, one, arm, known):
    """Returns values, and the derivative along `one` of the sum of known ones."""

    def total(s):
        moved = jax.tree.map(lambda a, b: a + s * b, x, one)
        found = motion(resets, moved, arm)
        return sum(jnp.sum(jnp.where(known[k], found[k], 0)) for k in known), found

    slope, found = jax.grad(total, has_aux=True)(0.0)
    return found, slope


def quarter(sine2):
    """Returns the complete elliptic integral K, by the mean of Gauss."""
    a, b = 1.0, jnp.sqrt(1 - sine2)
    for _ in range(6):
        a, b = (a + b) / 2, jnp.sqrt(a * b)
    return np.pi / 2 / a


def of_fall(q0, qd0, gravity, stop_at, **_):
    fast = jnp.sqrt(qd0**2 + 2 * gravity * (q0 - stop_at))
    return dict(t=(qd0 + fast) / gravity, q=stop_at, qd=-fast)


def of_bar(q0, gravity, mass, **_):
    moment, inertia = mass * gravity / 2, 1 / 12 + mass / 4
    time = jnp.sqrt(inertia / moment) * quarter(jnp.sin((q0 - HANGS) / 2) ** 2)
    return dict(t=time, q=HANGS, qd=-jnp.sqrt(2 * moment / inertia * (1 + jnp.sin(q0))))


def of_swing(qd0, gravity, **_):
    pace = 1.5 * gravity
    return dict(t=2 * quarter(qd0**2 / 4 / pace) / jnp.sqrt(pace), q=HANGS, qd=-qd0)


def of_blow(q0, gravity, restitution, **_):
    fast = jnp.sqrt(2 * gravity * q0)
    return dict(t=fast / gravity, q=0 * q0, qd=restitution * fast)


def of_push(q0, gravity, restitution, above, below, t1, **_):
    fall = jnp.sqrt(2 * q0 / (gravity - below))
    speed, rest = restitution * (gravity - below) * fall, t1 - fall
    pull = gravity - above
    return dict(q=speed * rest - pull * rest**2 / 2, qd=speed - pull * rest)


def of_table(q0, gravity, rise, lift, down, add, t1, **_):
    speed = jnp.sqrt(rise**2 + 2 * gravity * q0)
    blow = (speed - rise) / gravity
    back, since = down * (rise - speed) + add, t1 - blow
    q = rise * blow + lift + back * since - gravity * since**2 / 2
    return dict(q=q, qd=back - gravity * since, jumps=blow[None])


def of_twenty(q0, gravity, down, t1, **_):
    fall, kept = jnp.sqrt(2 * q0 / gravity), -down
    jumps = fall * jnp.cumsum((2 * kept ** jnp.arange(20)).at[0].set(1))
    speed, since = kept**20 * gravity * fall, t1 - jumps[-1]
    q, qd = speed * since - gravity * since**2 / 2, speed - gravity * since
    return dict(q=q, qd=qd, jumps=jumps, taken=gravity * q0 * (1 - kept**40))


# Programs, closed forms, arms, numbers that vary, and those that do not.
CASES = {
    "a fall ends on the floor": (
        of_ends, of_fall, MASS, dict(q0=10.0, qd0=1.0, gravity=9.81, stop_at=0.3), {},
    ),
    "a bar hangs after an elliptic integral": (
        of_ends, of_bar, BAR, dict(q0=0.0, gravity=9.81, mass=1.3),
        dict(stop_at=HANGS),
    ),
    "a bar that starts on the zero returns after half its period": (
        of_ends, of_swing, BAR, dict(qd0=5.0, gravity=9.81),
        dict(q0=HANGS, stop_at=HANGS),
    ),
    "a level ends a fall": (
        of_blows, of_fall, MASS, dict(q0=10.0, qd0=1.0, gravity=9.81, stop_at=0.3),
        dict(stop_q=1.0),
    ),
    "a blow carries the condition over its zero": (
        of_blows, of_blow, MASS, dict(q0=1.0, gravity=9.81, restitution=0.6),
        dict(stop_qd=-1.0),
    ),
    "a blow switches an effort at once": (
        of_blows, of_push, MASS,
        dict(q0=1.0, gravity=9.81, restitution=0.9, above=-4.0, below=1.0, t1=0.7),
        dict(side=1.0),
    ),
    "a ball is thrown by a table that rises": (
        of_resets, of_table, MASS,
        dict(q0=1.0, gravity=9.81, rise=0.5, lift=0.05, down=-0.6, add=0.8, t1=0.6), {},
    ),
    "a ball is reset twenty times": (
        of_resets, of_twenty, MASS, dict(q0=1.0, gravity=9.81, down=-0.95, t1=11.3), {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_times_and_states_are_closed_forms(name):
    """With derivatives along a random change of the numbers that vary."""
    program, exactly, arm, varied, fixed = CASES[name]
    x = {k: jnp.array(v) for k, v in (NOTHING | varied | fixed).items()}
    rng = np.random.default_rng(0)
    one = {k: rng.uniform(0.5, 1) * (k in varied) for k in x}
    (right, slopes), (_, curves) = twice(lambda x: exactly(**x), x, one)
    if program is of_ends:
        (found, first), (_, second) = program(x, one, arm)
    elif program is of_blows:
        found, first = program(x, one, arm)
    else:
        # Of the jumps of all that programs share, only some happen.
        count = right["jumps"].size
        known = dict(
            q=True, qd=True, taken="taken" in right, jumps=np.arange(20) < count
        )
        found, total = program(x, one, arm, known)
        wanted = sum(jnp.sum(slope) for slope in slopes.values())
        np.testing.assert_allclose(total, wanted, rtol=1e-9)
        found["jumps"] = found["jumps"][:count]
    for k, value in right.items():
        np.testing.assert_allclose(found[k], value, rtol=1e-11, atol=1e-11)
        if program is not of_resets:
            np.testing.assert_allclose(first[k], slopes[k], rtol=1e-9, atol=1e-9)
        if program is of_ends:
            np.testing.assert_allclose(second[k], curves[k], rtol=1e-8, atol=1e-8)


def test_the_first_of_several_ends_it():
    """The speed falls through 0, which the first condition does not count."""
    speed = lambda t, q, qd, linkage: qd[0]
    until, ts = (Until(speed, 1), height, Until(speed, -1)), [0, 0.1, 2.0]
    motion = fj.simulate(MASS, fj.State([10.0], [1.0]), ts, until=until)
    np.testing.assert_allclose([*motion.end][::3], [1 / 9.81, 2], rtol=1e-12)
    assert motion.ended and motion.outcome == "ended" and "ended" in repr(motion)
    np.testing.assert_allclose(motion.stats["time_reached"], motion.end.t, rtol=1e-9)
    assert np.isfinite(motion.q[:2]).all() and np.isnan(motion.q[2:]).all()
    free = fj.simulate(MASS, fj.State([10.0], [1.0]), [0, 0.05], until=until)
    assert not free.ended and free.outcome == "successful"
    assert (free.end.t, free.end.condition) == (0.05, -1)
    np.testing.assert_array_equal(free.end.q, free.q[-1])


def test_members_of_a_sweep_jump_and_end_by_themselves():
    speeds = np.array([0.0, 30.0, np.nan])
    start = fj.State(np.ones((3, 1)), speeds[:, None])
    rises = Until(lambda t, q, qd, linkage: q[0] - 0.2, direction=1)
    bounces = Reset(height, lambda t, q, qd, linkage: (q, -0.5 * qd), -1)
    swept = fj.sweep(MASS, start, [0, 0.9], (bounces, rises), solver=LoopedDopri8())
    assert swept.outcome.tolist() == ["ended", "successful", "not finite"]
    assert swept.events.count.tolist() == [1, 0, 0]
    fall, up = np.sqrt(2 / 9.81), np.sqrt(2 * 9.81) / 2
    end = fall + (up - np.sqrt(up**2 - 2 * 9.81 * 0.2)) / 9.81
    np.testing.assert_allclose(swept.end.t[:2], [end, 0.9], rtol=1e-11)


def test_jumps_over_other_conditions_are_those_there():
    """A payload slows a bar; so it is lifted over where it is pushed."""
    load = Payload(fj.Point(1, 1.0), mass=1.5, begin=0.5)
    slow = lambda t, q, qd, linkage: qd[0] - 1
    lifts = Reset(slow, lambda t, q, qd, linkage: (q + 1, qd), -1)
    over = lambda t, q, qd, linkage: q[0] - 1.5
    pushes = Reset(over, lambda t, q, qd, linkage: (q, qd + 0.5), 1)
    start, arm = fj.State([0.0], [2.0]), BAR.replace(gravity=0)
    motion = fj.simulate(arm, start, [0, 1.0], (pushes, lifts, load))
    table = motion.events.table
    assert table["event"].tolist() == ["is reset"] * 2 and not table["joint"].any()
    np.testing.assert_allclose(table["t [s]"], 0.5, rtol=1e-12)
    speed = 2 * (1 / 3) / (1 / 3 + 1.5) + 0.5
    np.testing.assert_allclose(motion.qd[-1], speed, rtol=1e-11)
    np.testing.assert_allclose(motion.q[-1], 2 + speed / 2, rtol=1e-11)


def jumping(
    start, speed=0.0, gravity=9.81, t1=0.7, floor=0.0, low=-9.0, kept=-0.5, lift=0.0,
    throw=True,
):  # fmt: skip
    """A mass is reset at the floor, below a hard stop; at `low` its motion ends."""
    jumps = Reset(
        lambda t, q, qd, linkage: q[0] - floor,
        lambda t, q, qd, linkage: (q + lift, kept * qd),
    )
    ends = Until(lambda t, q, qd, linkage: q[0] - low)
    scene = MASS.replace(gravity=gravity), fj.State([start], [speed]), [0, t1]
    switches = lambda t, q, qd, linkage: switch(q[0] - 0.9, 0 * q, 0 * q)
    forces = jumps, ends, HardStops(-np.inf, 2.0), switches
    return fj.simulate(*scene, forces, throw=throw)


@pytest.mark.parametrize("restitution", [0.1, 0.8])
def test_jumps_that_follow_each_other_ever_faster_are_named(restitution):
    """Of a ball that comes to rest, after a time that its restitution gives."""
    motion = jumping(1.0, kept=-restitution, t1=9.0, throw=False)
    assert motion.outcome == "too many switches"
    rests = np.sqrt(2 / 9.81) * (1 + restitution) / (1 - restitution)
    np.testing.assert_allclose(motion.stats["time_reached"], rests, rtol=1e-5)
    with pytest.raises(RuntimeError, match=r"is reset\. forces\[0\] \(Reset\)"):
        jumping(1.0, kept=-restitution, t1=9.0)


def test_where_a_reset_leaves_its_condition():
    """On its zero, beyond it, or before it, from where it comes again."""
    moved = partial(jumping, speed=1.0, gravity=0.0, t1=1.0, throw=False)
    for start, lift, kept, end in [
        (0.0, 0.0, -1.0, 1.0),  # it starts on the zero
        (-0.5, 0.0, -1.0, -0.5),
        (-0.5, 0.0, 2.0, 1.0),  # it goes on
        (-0.5, 0.3, 1.0, 0.8),
        (-0.5, -0.3, 1.0, -0.1),  # and twice
    ]:
        found = moved(start, lift=lift, kept=kept).q[-1, 0]
        np.testing.assert_allclose(found, end, atol=1e-12)
    assert moved(-0.5, lift=-1e-9, kept=1.0).outcome == "too many switches"


WRONG = [
    (dict(floor=np.nan), r"forces\[0\] is not finite"),
    (dict(low=np.nan), r"effort of forces\[1\] is not finite"),
    (dict(kept=np.nan), "new values are"),
    (dict(lift=9.0), "beyond a hard stop"),
]


@pytest.mark.parametrize("wrong, words", WRONG)
def test_functions_that_return_what_cannot_be_are_named(wrong, words):
    assert jumping(1.0).events.count == 1
    with pytest.raises(RuntimeError, match=words):
        jumping(1.0, **wrong)
