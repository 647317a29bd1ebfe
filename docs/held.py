"""Values and picture of docs/held.md: `python docs/held.py` prints and makes them."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

fj.configure(x64=True)
FORWARD = diffrax.ForwardMode()
GRAVITY, INF = 9.81, np.inf
SLIDE = dict(length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])
BAR = dict(length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
BARS = dict(length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1, 1], inertia=[1 / 12] * 2)
RISING = fj.Linkage("P", **SLIDE)
SLIDING = fj.Linkage("P", gravity=0, **SLIDE)
LEVEL = fj.Linkage("R", **BAR)
WEIGHTLESS = fj.Linkage("R", gravity=0, **BAR)
TWO = fj.Linkage("RR", gravity=0, **BARS)
JUST = 1e-10  # after an event, for steps end a little later or earlier [s]


class Row(NamedTuple):
    """A value of a scene, as computed and in closed form."""

    scene: str
    value: str
    found: float
    right: float

    @property
    def difference(self) -> float:
        return float(self.found - self.right)


def held_bar() -> Iterator[Row]:
    """A level bar on a pivot, at rest, by friction above and below its load."""
    load = GRAVITY / 2

    @jax.jit
    @lambda f: jax.jacfwd(f, has_aux=True)  # one program for motions and derivatives
    def end(level, ts):
        friction = fj.forces.JointFriction(level)
        start = fj.State([0.0], [0.0])
        motion = fj.simulate(LEVEL, start, ts, (friction,), adjoint=FORWARD)
        return motion.q[-1, 0], motion

    more, less = "bar, friction 1.5 of its load", "bar, friction 0.9 of its load"
    slope, rests = end(1.5 * load, np.array([0, 5.0, 10.0]))
    yield Row(more, "angle after 10 s [rad]", rests.q[-1, 0], 0)
    yield Row(more, "its derivative in the level", slope, 0)
    _, falls = end(0.9 * load, np.array([0, 1e-5, 3.0]))
    yield Row(less, "mode after 1e-5 s", falls.modes[1, 0], 0)
    yield Row(less, "rate after 1e-5 s [rad/s]", falls.qd[1, 0], -1.4715e-5)
    # What gravity gave is what friction took: sin(x) = 0.9 x.
    yield Row(less, "rests again at [rad]", falls.q[-1, 0], -0.7866830720492116)


def slide(level=2.0, x0=0.51, ts=(0.0, 5.0)) -> fj.Solution:
    """A slide of 1 kg on a spring, with friction, from rest."""
    start = fj.State(jnp.stack([jnp.asarray(x0)]), [0.0])
    forces = fj.forces.JointSpring(100), fj.forces.JointFriction(level)
    return fj.simulate(SLIDING, start, ts, forces, adjoint=FORWARD)


def sprung_slide() -> Iterator[Row]:
    def end(level, x0):
        motion = slide(level, x0)
        return motion.q[-1, 0], motion

    both = jax.jit(jax.jacfwd(end, argnums=(0, 1), has_aux=True))
    (in_level, in_x0), motion = both(2.0, 0.51)
    name = "slide, spring and friction"
    yield Row(name, "stops at [m]", motion.q[-1, 0], 0.01)
    yield Row(name, "stops after [s]", motion.events.t[0], 13 * np.pi / 10)
    yield Row(name, "d stop / d level [m/N]", in_level, 0.26)
    yield Row(name, "d stop / d start", in_x0, -1)


def mass_on_belt() -> Iterator[Row]:
    """In the frame of the belt, which moves at 0.1 m/s, the spring's anchor moves."""

    def spring(t, q, qd, linkage):
        return -100 * (q + 0.1 * t)

    slips = 0.3 + 0.15 * np.pi + 0.2  # the second time
    ts = [0, slips + np.pi / 40, 2.0]  # farthest between these
    friction = fj.forces.JointFriction(2, static=3)
    start = fj.State([0.0], [0.0])
    motion = fj.simulate(SLIDING, start, ts, (spring, friction))
    name, t = "mass on a belt", motion.events.t
    farthest = motion.q[1, 0] + 0.1 * ts[1]
    yield Row(name, "slips for [s]", t[3] - t[2], 0.15 * np.pi)
    yield Row(name, "sticks for [s]", t[2] - t[1], 0.2)
    yield Row(name, "amplitude about 0.02 m [m]", farthest - 0.02, 0.02 / 2**0.5)


def drop(height=1.0, ts=(0.0, 2.0)) -> fj.Solution:
    """A mass that is dropped on a hard stop, and bounces."""
    floor = fj.forces.HardStops(0.0, INF, restitution=0.5)
    start = fj.State(jnp.stack([jnp.asarray(height)]), [0.0])
    return fj.simulate(RISING, start, ts, (floor,), adjoint=FORWARD)


def bouncing_mass() -> Iterator[Row]:
    fall = np.sqrt(2 / GRAVITY)

    def rests(height):
        motion = drop(height, [0, 1.5 * fall, 2.25 * fall, 2.0])
        return jnp.nanmax(motion.events.t), motion

    slope, motion = jax.jit(jax.jacfwd(rests, has_aux=True))(1.0)
    floor = fj.forces.HardStops(0.0, INF, restitution=0.5)
    effort = fj.joint_efforts(RISING, (floor,), motion).elements[0, -1, 0]
    name = "mass on a hard stop, e = 0.5"
    yield Row(name, "first rebound [m]", motion.q[1, 0], 0.25)
    yield Row(name, "second rebound [m]", motion.q[2, 0], 0.0625)
    yield Row(name, "rests from [s]", jnp.nanmax(motion.events.t), 3 * fall)
    yield Row(name, "d that / d height [s/m]", slope, 1.5 * fall)
    yield Row(name, "effort of the stop [N]", effort, GRAVITY)


def bar_on_stop() -> Iterator[Row]:
    stop = fj.forces.HardStops(-np.pi / 2, INF, restitution=0.6)
    start, before = fj.State([0.0], [0.0]), np.sqrt(3 * GRAVITY)
    hits = fj.simulate(LEVEL, start, [0, 1.0], (stop,)).events.t[0]
    ts = [0, hits - JUST, hits + JUST, *np.linspace(hits + 0.1, hits + 0.6, 1001)]
    motion = fj.simulate(LEVEL, start, ts, (stop,))
    highest = np.argmax(motion.q[3:, 0]) + 3
    q, qd = motion.q[highest, 0], motion.qd[highest, 0]
    # The rate is a straight line in the millisecond about the highest place.
    q = q + qd**2 / (3 * GRAVITY * np.cos(q))
    swing = np.arccos(1 - 0.6**2)
    name = "bar on a stop where it hangs, e = 0.6"
    yield Row(name, "rate before [rad/s]", -motion.qd[1, 0], before)
    yield Row(name, "rate after [rad/s]", -motion.qd[2, 0], -0.6 * before)
    yield Row(name, "swings back by [rad]", q + np.pi / 2, swing)


def take(velocity=(0.0, 0.0), ts=(0.0, 1.0)) -> fj.Solution:
    """A turning bar that takes a payload at its tip."""
    tip = fj.Point(1, along=1)
    load = fj.forces.Payload(tip, 1.5, begin=0.5, velocity=velocity)
    return fj.simulate(WEIGHTLESS, fj.State([0.0], [2.0]), ts, (load,))


def bar_and_payload() -> Iterator[Row]:
    name, along = "bar takes a payload", [-2 * np.sin(1), 2 * np.cos(1)]
    yield Row(name, "at rest: rate after [rad/s]", take().qd[-1, 0], 4 / 11)
    yield Row(name, "moving along: rate after [rad/s]", take(along).qd[-1, 0], 2)


def backwards(q, qd, t) -> fj.State:
    """The state of the two bars from which they come to (q, qd) in a time."""
    end = fj.simulate(TWO, fj.State(q, -np.asarray(qd)), [0, t])
    return fj.State(end.q[-1], -end.qd[-1])


def two_bars() -> Iterator[Row]:
    begin = 0.2
    start = backwards([0.3, 0.8], [1.0, 2.0], begin)
    brake = fj.forces.Brake(2, begin)
    stop = fj.forces.HardStops([-INF, -INF], [INF, 0.8], restitution=0.4)
    (hits, *_) = fj.simulate(TWO, start, [0, 1.1 * begin], (stop,)).events.t
    braked = fj.simulate(TWO, start, [0, begin + JUST], (brake,)).qd[-1]
    hit = fj.simulate(TWO, start, [0, hits + JUST], (stop,)).qd[-1]
    # M = (a, b; b, 1/3): an impulse in joint 2 changes rates by a multiple of (-b, a).
    a, b = 5 / 3 + np.cos(0.8), 1 / 3 + np.cos(0.8) / 2
    for name, qd, after in (
        ("two bars, brake on joint 2", braked, 0.0),
        ("two bars, stop of joint 2, e = 0.4", hit, -0.8),
    ):
        yield Row(name, "rate of joint 1 [rad/s]", qd[0], 1 + b * (2 - after) / a)
        yield Row(name, "rate of joint 2 [rad/s]", qd[1], after)


SCENES = (
    held_bar, sprung_slide, mass_on_belt, bouncing_mass, bar_on_stop, bar_and_payload,
    two_bars,
)  # fmt: skip


def rows() -> list[Row]:
    """Returns all values."""
    return [row for scene in SCENES for row in scene()]


def report(values: list[Row]) -> str:
    """Returns a table of values in closed form; computed ones differ as shown."""
    lines, scene = [f"{'':34}{'closed form':>17}  difference"], ""
    for row in values:
        if row.scene != scene:
            lines.append(scene := row.scene)
        numbers = f"{row.right:17.11g}{row.difference:12.0e}"
        lines.append(f"  {row.value:32}{numbers}")
    return "\n".join(lines)


def shade(ax, ts, held, color: str, label: str) -> None:
    """Shades the times in which a joint is held, or a payload is carried."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], held, [0]]).astype(int)))
    for begin, end in edges.reshape(-1, 2):
        span = ts[max(begin - 1, 0)], ts[end - 1]
        ax.axvspan(*span, color=color, alpha=0.2, lw=0, label=label)
        label = "_"


def picture(path: Path) -> None:
    """Draws a motion for each of the four elements."""
    import matplotlib

    matplotlib.use("agg")  # the picture is written, never shown
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 2, figsize=(9.6, 6.0), layout="constrained")
    (friction, stops), (brake, payload) = panels

    ts = np.linspace(0, 5, 1001)
    motion = slide(ts=ts)
    friction.axhspan(-0.02, 0.02, color="0.88", lw=0, label="friction can hold it here")
    friction.plot(ts, motion.q[:, 0], "C0")
    shade(friction, ts, motion.modes[:, 0] == 1, "C1", "held by friction")
    friction.set(
        ylabel="position [m]", title="JointFriction: a sprung slide stops short of 0"
    )

    ts = np.linspace(0, 2, 1001)
    motion = drop(ts=ts)
    bounces = np.asarray(motion.events.t)[np.asarray(motion.events.kind) == 2]
    stops.plot(ts, motion.q[:, 0], "C0")
    label = f"{bounces.size} bounces"
    stops.plot(bounces, 0 * bounces, "C3.", label=label, clip_on=False)
    shade(stops, ts, motion.modes[:, 0] == 2, "C1", "rests on the stop")
    stops.set(
        ylabel="height [m]",
        ylim=(0, None),
        title="HardStops: a dropped mass bounces to rest",
    )

    ts = np.linspace(0, 2, 1001)
    arm = fj.Linkage("RR", **BARS)
    hold = fj.forces.Brake(2, 0.6, 1.3)
    motion = fj.simulate(arm, fj.State([0.0, 0.0], [0.0, 0.0]), ts, (hold,))
    brake.plot(ts, motion.qd[:, 0], "C0", label="joint 1")
    brake.plot(ts, motion.qd[:, 1], "C2", label="joint 2")
    shade(brake, ts, motion.modes[:, 1] == 4, "C1", "joint 2 braked")
    brake.set(ylabel="rate [rad/s]", title="Brake: two bars fall, one joint is braked")

    begin, end = 0.5, 1.4
    load = fj.forces.Payload(fj.Point(1, along=1), 1.5, begin=begin, end=end)
    start = fj.State([0.0], [0.0])
    motion = fj.simulate(LEVEL, start, ts, (load,))
    alone = fj.simulate(LEVEL, start, ts)
    payload.plot(ts, alone.qd[:, 0], "C0--", lw=1, label="without payload")
    payload.plot(ts, motion.qd[:, 0], "C0", label="with payload")
    shade(payload, ts, (ts >= begin) & (ts < end), "C1", "carries 1.5 kg at its tip")
    payload.set(
        ylabel="rate [rad/s]", title="Payload: a falling bar of 1 kg takes 1.5 kg"
    )

    for ax in panels.flat:
        ax.set(xlabel="t [s]", xlim=(0, ax.lines[0].get_xdata()[-1]))
        ax.title.set_fontsize("medium")
        ax.legend(fontsize="small")
    friction.legend(fontsize="small", loc="upper right", bbox_to_anchor=(0.8, 1))
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    print(report(rows()))
    picture(Path(__file__).with_suffix(".png"))
