"""Plots of how joints answer steps and sines."""

import numpy as np
from matplotlib.figure import Figure

from ..analysis.responses import StepAndSine
from ..base.checks import instance
from .arms import link_color
from .axes import BLACK, GREY, figure_or_new, legend


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
