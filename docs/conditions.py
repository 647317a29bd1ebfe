"""Makes conditions.png, of docs/conditions.md: `python docs/conditions.py`."""

from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np

matplotlib.use("agg")  # the picture is written, never shown

import matplotlib.pyplot as plt

import fdof_jax as fj

fj.configure(x64=True)
HANGS, SHORT, ANGLE = -np.pi / 2, 0.6, 0.8  # [rad], [m], [rad]
HALF, SLOPE = 0.3, 0.08  # between spokes, of the ground [rad]
MIDDLE, KEPT = np.pi / 2 - SLOPE, np.cos(2 * HALF)
STRING = fj.Linkage("R", length=[0, 1], com=[[1, 0]], mass=[1], inertia=[0])


def side(t, q, qd, linkage):
    return q[0] - HANGS


def fall(ax):
    """Bars from three angles, until they hang."""
    bar = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
    ts = np.linspace(0, 0.9, 181)
    for start, color in ((0.0, "C0"), (0.6, "C2"), (1.2, "C4")):
        motion = fj.simulate(bar, fj.State([start], [0.0]), ts, until=side)
        ax.plot(ts, motion.q[:, 0], color, label=f"from {start:g} rad")
        ax.plot(motion.end.t, motion.end.q[0], "o", color="C3")
    ax.plot([], [], "o", color="C3", label="ends")
    ax.set(xlim=(0, 1), ylim=(-1.8, 1.4), xlabel="t [s]", ylabel="angle [rad]")
    ax.set_title("until: bars fall until they hang")
    ax.legend(loc="upper right", fontsize="small")


def string(ax):
    """The path of a bob whose string meets a pin."""
    turn = lambda t, q, qd, linkage: (q, qd * jnp.where(qd > 0, 1 / SHORT, SHORT))

    def pull(t, q, qd, linkage):
        more = -(1 / SHORT - 1) * linkage.gravity * jnp.cos(q)
        return fj.forces.switch(side(t, q, qd, linkage), more, 0 * q, continuous=True)

    period = fj.State([HANGS - ANGLE], [0.0]), np.linspace(0, 1.879, 33)
    motion = fj.simulate(STRING, *period, (fj.forces.Reset(side, turn), pull))
    q = np.asarray(motion.q[:, 0])
    length = np.where(q > HANGS, SHORT, 1)
    x, y = length * np.cos(q), length - 1 + length * np.sin(q)
    for bob in zip(x, y, length - 1):
        ax.plot([0, bob[0]], [bob[2], bob[1]], color="0.8", lw=0.8)
    ax.plot([0, 0], [0, SHORT - 1], color="0.8", lw=0.8)
    ax.plot(x, y, "C0.", label="bob, each 0.06 s")
    ax.plot(0, 0, "k^", label="string fixed")
    ax.plot(0, SHORT - 1, "C3o", label="pin")
    ax.set(xlim=(-0.9, 1.5), ylim=(-1.1, 0.2), xlabel="x [m]", ylabel="y [m]")
    ax.set_aspect("equal")
    ax.set_title("Reset: a string meets a pin")
    ax.legend(loc="lower right", fontsize="small")


def wheel(ax):
    """Angle and rate of the spoke that stands, from two starts, and the cycle."""
    foot = fj.forces.Reset(
        when=lambda t, q, qd, linkage: q[0] - (MIDDLE - HALF),
        then=lambda t, q, qd, linkage: (q + 2 * HALF, KEPT * qd),
        direction=-1,
    )
    # Between two feet energy is kept.
    speed = lambda q, fast: -np.sqrt(fast**2 + 2 * 9.81 * (np.sin(MIDDLE) - np.sin(q)))
    drop, climb = (np.sin(MIDDLE) - np.sin(MIDDLE + end * HALF) for end in (-1, 1))
    cycle = np.sqrt(2 * 9.81 * (KEPT**2 * drop - climb) / (1 - KEPT**2))
    for start, color in ((-1.8, "C0"), (-1.0, "C2")):
        ts = np.linspace(0, 4, 1601)
        motion = fj.simulate(STRING, fj.State([MIDDLE], [start]), ts, (foot,))
        q, qd = np.array(motion.q[:, 0]), np.array(motion.qd[:, 0])
        jumps = np.flatnonzero(np.diff(q) > HALF) + 1
        q, qd = (np.insert(values, jumps, np.nan) for values in (q, qd))
        ax.plot(q - MIDDLE, qd, color, lw=1, label=f"from {start:g} rad/s")
    angles = MIDDLE + np.linspace(HALF, -HALF, 101)
    ax.plot(angles - MIDDLE, speed(angles, cycle), "C3", lw=2.5, label="limit cycle")
    ax.set(
        xlim=(-0.32, 0.32), ylim=(-2.4, -0.8),
        xlabel="angle from the middle [rad]", ylabel="rate [rad/s]",
    )  # fmt: skip
    ax.set_title("A rimless wheel comes to its limit cycle")
    ax.legend(loc="lower right", fontsize="small")


def clutch(ax):
    """Rates of two discs, which a clutch locks."""
    discs = fj.Linkage(
        "RR", length=[0, 1, 0], com=[[0, 0]] * 2, mass=[1, 0], inertia=[0.5, 0.8],
        gravity=0.0,
    )  # fmt: skip
    closes = lambda t, q, qd, linkage: 4 * t * jnp.array([0, 1])
    ts, start = np.linspace(0, 1.2, 241), fj.State([0.0, 0.0], [3.0, -3.0])
    motion = fj.simulate(discs, start, ts, (fj.forces.JointFriction(closes),))
    locks = motion.events.t[0]
    ax.plot(ts, motion.qd[:, 0], "C0", label="disc 1")
    ax.plot(ts, motion.qd.sum(axis=1), "C2", label="disc 2")
    ax.axvspan(locks, ts[-1], color="C1", alpha=0.2, lw=0, label="locked")
    ax.set(xlim=(0, ts[-1]), ylim=(0, 3.2), xlabel="t [s]", ylabel="rate [rad/s]")
    ax.set_title("JointFriction: a clutch closes")
    ax.legend(loc="upper right", fontsize="small")


figure, panels = plt.subplots(2, 2, figsize=(9.6, 6.4), layout="constrained")
for ax, draw in zip(panels.flat, (fall, string, wheel, clutch)):
    draw(ax)
    ax.title.set_fontsize("medium")
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
