"""Curves of motions over time and of the tip's path, with matplotlib.

The curves show joint motion, energies, efforts, tracking of a task, and the cost of
accuracy. Arguments and results are as in `drawing`, which holds the pictures of the
linkage itself.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from ..analysis.responses import StepAndSine
from ..base.checks import instance, real_array, refusal, shown
from ..control.drives import PIDController
from ..control.pd import PDController
from ..forces.element import Forces, elements
from ..linkage.linkage import Linkage, joint_names, moving_joints
from ..simulation.efforts import joint_efforts
from ..simulation.sampled import Motion
from .arms import geometry, link_color
from .axes import (
    BLACK,
    GREY,
    LIGHT_GREY,
    SERIES,
    axes_or_new,
    figure_or_new,
    filled_mapping,
    legend,
    reached,
    time_panels,
)
from .energies import energy_profile, energy_stack
from .tracking import tracking, tracking_by_error, tracking_error

__all__ = [
    "effort_profile", "energy_profile", "energy_stack",
    "motion_profile", "response_profile", "tracking", "tracking_by_error",
    "tracking_error", "work_precision",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


def motion_profile(
    linkage: Linkage, solution: Motion, fig: Figure | None = None
) -> Figure:
    """Plots the motion of the real joints over time, as in the paper's Figs 4 and 6.

    One panel shows the angles of links on revolute joints from the x axis, not from the
    link before as in `q` [degrees], another the slides of prismatic joints [m]; theta_k
    and B_k are those of joint k.
    """
    ts, q, _ = reached(linkage, solution)
    g = geometry(linkage, q)
    angles, slides = [], []
    for k, kind in enumerate(g.kinds, start=1):
        if kind == "R":
            degrees = np.rad2deg(g.angle[:, k])
            angles.append((rf"$\theta_{k}$", degrees, link_color(k)))
        elif kind == "P":
            slides.append((f"$B_{k}$", g.slide[:, k - 1], link_color(k)))
    panels = [("absolute angle [degrees]", angles), ("slide [m]", slides)]
    panels = [panel for panel in panels if panel[1]]
    fig = figure_or_new(fig, 3.5, 0.6 + 1.9 * len(panels))
    for ax in time_panels(fig, ts, panels):
        legend(ax)
    return fig


def effort_profile(
    linkage: Linkage, forces: Forces, solution: Motion, fig: Figure | None = None
) -> Figure:
    """Plots joint efforts over time with their limits, a panel per joint [N or N m].

    One curve is the total effort, of dampers and springs too. The grey band lies within
    the finite limits of a `PDController`, `PIDController`, `GravityFeedforward` or
    `ComputedTorque`; it fills the panel where the efforts stay far from the limits.
    Where other elements act beside such a controller, a second curve is its own effort.
    Orange dots mark samples at which the controller is at its limit.

    **Arguments:** `forces`: those of the solution.
    """
    reached(linkage, solution)
    efforts = joint_efforts(linkage, forces, solution)
    ts, total, parts = (np.asarray(a) for a in (solution.ts, *efforts))
    units, panels = [], []
    moving = moving_joints(linkage)
    for k in moving:
        symbol, unit = ("T", "N m") if joint_names(linkage)[k][0] == "R" else ("F", "N")
        curve = "total", total[:, k], SERIES[0]
        panels.append((f"${symbol}_{k + 1}$ [{unit}]", [curve]))
        units.append(unit)
    fig = figure_or_new(fig, 3.5, 5.2)
    axes = time_panels(fig, ts, panels)
    for k, ax, unit in zip(moving, axes, units):
        rows = zip(elements("forces", forces), parts[:, :, k])
        limits = [(_limit(element, k, total.shape[1]), row) for element, row in rows]
        limits = [(limit, effort) for limit, effort in limits if np.isfinite(limit)]
        for _, effort in limits if len(parts) > 1 else ():
            ax.plot(ts, effort, color=SERIES[2], lw=1.2, label="controller")
        low, high = ax.get_ylim()  # before the bands, which may be far wider
        texts = []
        for limit, effort in limits:
            ax.axhspan(-limit, limit, color=GREY, alpha=0.15, lw=0, label="limits")
            at = (np.abs(effort) >= limit) & (effort != 0)
            dots = ax.plot(ts[at], effort[at], ".", color=SERIES[1], zorder=3)
            dots[0].set(label="saturated", gid=f"saturated {k + 1}")
            if at.any():
                low, high = min(low, -1.1 * limit), max(high, 1.1 * limit)
            texts.append(f"limit ±{limit:g} {unit}")
        ax.set_ylim(low, high)
        _note(ax, "\n".join(texts))
    legend(axes[0], *axes)
    return fig


def _limit(element: Any, joint: int, joints: int) -> float:
    """The limit of a controller's effort at a joint; infinite for other elements."""
    element = element.pd if isinstance(element, PIDController) else element
    if not isinstance(element, PDController):
        return np.inf
    return float(np.broadcast_to(np.asarray(element.limit), joints)[joint])


def _note(ax: Axes, text: str) -> None:
    """Writes into the first corner of axes that no curve enters, or else the first."""
    if not text:
        return

    def hidden(x: float, y: float) -> int:
        curves = (ax.transLimits.transform(line.get_xydata()) for line in ax.lines)
        near = [(np.abs(curve - (x, y)) < (0.45, 0.25)).all(axis=1) for curve in curves]
        return sum(int(found.sum()) for found in near)

    x, y = min([(1, 0), (1, 1), (0, 0), (0, 1)], key=lambda corner: hidden(*corner))
    ax.annotate(
        text, (x, y), (5 - 10 * x, 6 - 12 * y), xycoords="axes fraction",
        textcoords="offset points", ha=["left", "right"][x], va=["bottom", "top"][y],
        fontsize="small", bbox={"fc": "white", "alpha": 0.7, "lw": 0, "pad": 1},
    )  # fmt: skip


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


def work_precision(
    measured: Mapping[str, tuple[ArrayLike, ArrayLike]], ax: Axes | None = None
) -> Axes:
    """Plots times over errors, both on logarithmic axes: the cost of accuracy.

    The unit of the errors is yours; the axis is labelled "error".

    **Arguments:** `measured`: label -> (errors, times [s]), equally many, all above 0,
    in any order.
    """
    curves = {}
    for label, pair in filled_mapping("measured", measured, "(errors, times)").items():
        name = f"measured[{shown(label)}]"
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise refusal(name, "(errors, times)", pair)
        errors, times = (
            np.asarray(real_array(name, p, (None,), above=0)) for p in pair
        )
        if len(errors) != len(times):
            got = f"{len(errors)} errors and {len(times)} times"
            raise ValueError(f"{name}: expected as many errors as times, got {got}.")
        order = np.argsort(errors)
        curves[str(label)] = errors[order], times[order]
    ax = axes_or_new(ax, 2.8)
    for k, (label, curve) in enumerate(curves.items()):
        style = dict(color=SERIES[k % len(SERIES)], marker="osD^v<"[k % 6])
        ax.loglog(*curve, lw=1.2, ms=4, label=label, **style)
    ax.set(xlabel="error", ylabel="time [s]")
    ax.grid(which="major", lw=0.4, color=LIGHT_GREY)
    legend(ax)
    return ax
