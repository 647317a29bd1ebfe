"""Makes switches.png, the picture of docs/switches.md: `python docs/switches.py`."""

from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

matplotlib.use("agg")  # the picture is written, never shown

import matplotlib.pyplot as plt

import fdof_jax as fj

fj.configure(x64=True)
ARM, HOOK, REST = fj.scenes.fig5().linkage, np.array([0.0, 1.0]), 1.9
TS = np.linspace(0, 0.8, 161)
ANGLE, SHIFT = 0.1, 0.05  # of the start [rad]


def spring(**options):
    ends = fj.Point(0, *HOOK), fj.Point(1, 1.0)
    return fj.SpringDamper(
        *ends, stiffness=200, damping=20, rest_length=REST, **options
    )


def stretch(q):
    """How far the elbow is from the hook, beyond the cable's length [m]."""
    return jnp.linalg.norm(fj.joint_positions(ARM, q)[1] - HOOK) - REST


def chosen(t, q, qd, linkage):
    """The cable by a plain choice, which the integrator does not know of."""
    return jnp.where(stretch(q) > 0, spring()(t, q, qd, linkage), 0)


def motion(cable, tolerance=1e-11):
    def angles(angle):
        start = fj.State(angle * np.eye(3)[0], np.zeros(3))
        return fj.simulate(
            ARM, start, TS, (cable, fj.JointDamper(1.0)), rtol=tolerance,
            atol=tolerance, adjoint=diffrax.ForwardMode(),
        ).q  # fmt: skip

    return jax.jit(angles), jax.jit(jax.jacfwd(angles))


located, slope = motion(spring(one_sided="cable"))
_, plain_slope = motion(chosen)
tight, _ = motion(spring(one_sided="cable"), 1e-13)
h = 1e-4
differences = (tight(ANGLE + h) - tight(ANGLE - h)) / (2 * h)

figure, (above, below) = plt.subplots(
    2, figsize=(7.2, 4.6), sharex=True, layout="constrained"
)
for angle, style in ((ANGLE, "C0"), (ANGLE + SHIFT, "C0--")):
    beyond = 1e3 * np.asarray(jax.vmap(stretch)(located(angle)))
    above.plot(TS, beyond, style, label=f"start at {angle:g} rad")
    taut = np.interp(0, beyond[: beyond.argmax()], TS[: beyond.argmax()])
    above.plot(taut, 0, "o", color="C1")
above.plot([], [], "o", color="C1", label="the cable becomes taut")
above.axhline(0, color="0.6", lw=0.8)
above.set(xlim=(0.45, TS[-1]), ylim=(-200, None), ylabel="stretch of the cable [mm]")
above.legend()
below.plot(TS, slope(ANGLE)[:, 0], "C0", label="derivative by fdof_jax")
below.plot(TS, plain_slope(ANGLE)[:, 0], "C3--", label="without the jump's term")
below.plot(TS[::4], differences[::4, 0], "k.", label="differences of motions")
below.set(ylim=(0.5, 0.9), xlabel="t [s]", ylabel="d q[0] / d start")
below.legend()
figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)
