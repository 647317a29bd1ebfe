"""Plots of how joints answer steps and sines, and of the loops of their controllers."""

import numpy as np
from matplotlib.figure import Figure

from ..analysis.loops import OpenLoop
from ..analysis.responses import StepAndSine
from ..base.checks import instance
from .arms import link_color
from .axes import BLACK, GREY, figure_or_new, legend

_BESIDE = np.linspace(-3, 3, 13)  # frequencies beside a mode, over its decay


def response_profile(test: StepAndSine, fig: Figure | None = None) -> Figure:
    """Plots the answers of joints to steps over time, and to sines over frequency.

    The upper panel shows each joint's change over the height of its step. The lower
    one shows the amplitude over that of the reference [dB], a dot per frequency
    tested.

    **Arguments:** `test`: the result of `step_and_sine`.
    """
    instance("test", test, StepAndSine)
    fig = figure_or_new(fig, 3.5, 4.8)
    above, below = fig.subplots(2)
    above.axhline(1, color=BLACK, ls="--", lw=0.8, label="reference")
    rows = zip(test.joints, test.response, test.frequency, test.gain, test.bandwidth)
    for name, response, frequency, gain, bandwidth in rows:
        color = link_color(int(name[1:]))
        above.plot(test.ts, response, label=name, color=color, lw=1.2)
        level = 20 * np.log10(np.abs(gain))
        below.semilogx(frequency, level, "o", color=color, ms=2)
        at = np.interp(bandwidth, frequency, level)
        below.plot(bandwidth, at, "o", color=color, mfc="white", ms=5)
    below.plot([], [], "o", color=GREY, mfc="white", ms=5, label="bandwidth")
    above.set(xlabel="time since the step [s]", ylabel="change / step")
    below.set(xlabel="frequency [rad/s]", ylabel="amplitude / reference [dB]")
    below.grid(which="both", lw=0.3)
    legend(above, below)
    return fig


def bode_plot(loop: OpenLoop, fig: Figure | None = None) -> Figure:
    """Plots the frequency response of a controller's loop, with its margins (Bode).

    The upper panel shows the amplitude of L [dB], the lower one its phase [degrees].
    The gain margin stands where L is real and negative, at the left end if that is at
    rest, and the phase margin at the crossover. Margins that are infinite or NaN are
    left out.

    **Arguments:** `loop`: the result of `open_loop`.
    """
    instance("loop", loop, OpenLoop)
    fig = figure_or_new(fig, 3.5, 4.8)
    above, below = fig.subplots(2, sharex=True)
    crossover, factor = loop.crossover, loop.gain_margin
    closed = loop.A - np.outer(loop.B, loop.C)
    modes = np.linalg.eigvals([loop.A, closed]).ravel()
    rates = np.abs(modes)
    frequent = rates > 1e-6 * rates.max()  # without poles at rest, rounded
    rates, sway, decay = rates[frequent], modes.imag[frequent], modes.real[frequent]
    frequency = np.geomspace(rates.min() / 10, rates.max() * 10, 1000)
    # Peaks of lightly damped modes are narrower than these are apart. At an undamped
    # one, the response is infinite.
    damped = np.abs(decay) > 1e-6 * rates
    near = np.abs(sway) + np.multiply.outer(_BESIDE, decay)
    near = near[:, damped]
    near = near[(near > frequency[0]) & (near < frequency[-1])]
    if crossing := np.isfinite(loop.phase_margin):
        near = np.append(near, crossover)
    frequency = np.unique(np.append(frequency, near))
    response = loop(frequency)
    phase = np.rad2deg(np.unwrap(np.angle(response)))
    with np.errstate(divide="ignore"):  # a controller at its limit does not respond
        level = 20 * np.log10(np.abs(response))
    margin = dict(color=BLACK, marker="o", ms=4)
    if np.isfinite(factor):
        at = frequency[np.abs(response + 1 / factor).argmin()]
        ends = [0, -20 * np.log10(factor)]
        above.plot([at, at], ends, label=f"gain margin {factor:.3g}", **margin)
    if crossing:
        degrees = np.rad2deg(loop.phase_margin)
        # The phase is known up to whole turns; the margin is counted from -180.
        phase += degrees - 180 - phase[frequency.searchsorted(crossover)]
        label = f"phase margin {degrees:.3g}\N{DEGREE SIGN}"
        ends = [-180, degrees - 180]
        below.plot([crossover, crossover], ends, label=label, **margin)
    style = dict(color=link_color(int(loop.joint[1:])), lw=1.2)
    above.semilogx(frequency, level, label=f"loop of {loop.joint}", **style)
    below.semilogx(frequency, phase, label=f"loop of {loop.joint}", **style)
    for ax, edge, name in ((above, 0, "|L| = 1"), (below, -180, "L < 0")):
        ax.axhline(edge, color=BLACK, ls="--", lw=0.8, label=name)
        ax.grid(lw=0.3)
        legend(ax)
    above.set(ylabel="amplitude [dB]")
    below.set(xlabel="frequency [rad/s]", ylabel="phase [degrees]")
    return fig
