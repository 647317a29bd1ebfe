"""Curves of motions over time and of the tip's path, with matplotlib.

Joint motion, energies, efforts, and how a controlled tip tracks its task. Arguments and
results are as in `drawing`, which holds the pictures of the linkage itself.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .control import CircleTask, PDController, saturated
from .drawing import (
    BLACK,
    GREY,
    SERIES,
    axes_or_new,
    figure_or_new,
    filled_mapping,
    geometry,
    legend,
    plane_axes,
    reached,
    refuse,
    xy,
)
from .dynamics import link_energies
from .forces import Forces
from .linkage import Linkage
from .simulation import joint_efforts
from .solution import Solution


def _time_panels(fig: Figure, ts: np.ndarray, panels: list) -> list[Axes]:
    """Axes above each other: (y label, [(label, values, colour), ...]) over time."""
    axes = list(fig.subplots(len(panels), squeeze=False, sharex=True)[:, 0])
    for ax, (ylabel, curves) in zip(axes, panels):
        for label, values, color in curves:
            ax.plot(ts, values, color=color, lw=1.2, label=label)
        ax.set_ylabel(ylabel)
    axes[-1].set_xlabel("time [s]")
    fig.align_ylabels(axes)
    return axes


def motion_profile(
    linkage: Linkage, solution: Solution, fig: Figure | None = None
) -> Figure:
    """Motion of the real joints over time, as in the paper's Figs 4 and 6.

    Absolute angles th_n of the links that turn on a revolute joint [degrees], and in
    axes of their own the slides B_n of the prismatic joints [m].

    **Returns:** the figure.

    **Raises:** ValueError for malformed arguments.
    """
    ts, q, _ = reached(solution)
    g = geometry(linkage, q)
    angles, slides = [], []
    for k, revolute in enumerate(g.revolute):
        if revolute:
            degrees = np.rad2deg(g.angle[:, k + 1])
            angles.append((rf"$\theta_{k + 2}$", degrees, SERIES[k]))
        else:
            slides.append((f"$B_{k + 1}$", g.slide[:, k], SERIES[k]))
    panels = [("angle [degrees]", angles), ("slide [m]", slides)][: 1 + bool(slides)]
    fig = figure_or_new(fig, 3.5, 0.6 + 1.9 * len(panels))
    for ax in _time_panels(fig, ts, panels):
        legend(ax)
    return fig


def energy_profile(
    linkage: Linkage, solution: Solution, fig: Figure | None = None
) -> Figure:
    """Kinetic and potential energy of each link, and of all together, over time [J].

    **Returns:** the figure.

    **Raises:** ValueError for malformed arguments.
    """
    ts, q, qd = reached(solution)
    energies = jax.vmap(lambda q, qd: link_energies(linkage, q, qd))(q, qd)
    kinetic, potential = (np.asarray(each) for each in energies)
    names = "link 2", "link 3", "link 4"
    sums = kinetic.sum(axis=1), potential.sum(axis=1), (kinetic + potential).sum(axis=1)
    whole = zip(("kinetic", "potential", "total"), sums, (*SERIES[3:5], BLACK))
    panels = [
        ("kinetic energy [J]", list(zip(names, kinetic.T, SERIES))),
        ("potential energy [J]", list(zip(names, potential.T, SERIES))),
        ("of all links [J]", list(whole)),
    ]
    fig = figure_or_new(fig, 3.5, 6.0)
    top, _, bottom = _time_panels(fig, ts, panels)
    legend(top)
    legend(bottom)
    return fig


def effort_profile(
    linkage: Linkage, forces: Forces, solution: Solution, fig: Figure | None = None
) -> Figure:
    """Total joint efforts over time, one panel per joint [N or N m], with their limits.

    Grey is the band within the finite limits of a `PDController`; where the efforts
    stay far from them it fills the panel. Orange dots mark the samples at which the
    controller is saturated.

    **Arguments:** `forces`: those of the solution.

    **Returns:** the figure.

    **Raises:** ValueError for malformed arguments.
    """
    reached(solution)
    efforts = joint_efforts(linkage, forces, solution)
    ts, total, elements = (np.asarray(a) for a in (solution.ts, *efforts))
    units = np.where(np.asarray(linkage.ef)[1::2] > 0.5, "N m", "N")
    panels = []
    for k, unit in enumerate(units):
        symbol = f"$T_{k + 2}$" if unit == "N m" else f"$F_{k + 1}$"
        panels.append((f"{symbol} [{unit}]", [("total", total[:, k], SERIES[0])]))
    fig = figure_or_new(fig, 3.5, 5.2)
    axes = _time_panels(fig, ts, panels)
    for k, (ax, unit) in enumerate(zip(axes, units)):
        low, high = ax.get_ylim()  # not those of the bands, which may be far wider
        for element, effort in zip(forces, elements):
            if isinstance(element, PDController) and np.isfinite(element.limit[k]):
                limit = float(element.limit[k])
                ax.axhspan(-limit, limit, color=GREY, alpha=0.15, lw=0, label="limits")
                at = np.asarray(saturated(element, linkage, solution))[:, k]
                dots = ax.plot(ts[at], effort[at, k], ".", color=SERIES[1], zorder=3)
                dots[0].set(label="saturated", gid=f"saturated {k + 1}")
                if at.any():
                    low, high = min(low, -1.1 * limit), max(high, 1.1 * limit)
                text = ax.text(0.98, 0.08, f"limit ±{limit:g} {unit}", ha="right")
                text.set(fontsize="small", transform=ax.transAxes)
        ax.set_ylim(low, high)
    legend(axes[0], *axes)
    return fig


def _tips(linkage: Any, task: Any, solutions: Any) -> list[tuple]:
    """Per solution its label, colour, times, and commanded and actual tip positions."""
    if not callable(getattr(task, "tip", None)):
        raise refuse("task", "a CircleTask", task)
    curves = []
    for label, solution in filled_mapping("solutions", solutions, "Solution").items():
        ts, q, _ = reached(solution, f"solutions[{label!r}]")
        commanded = np.asarray(jax.vmap(task.tip)(jnp.asarray(ts))) @ [1, 1j]
        actual = geometry(linkage, q).end[:, 3]
        color = SERIES[len(curves) % len(SERIES)]
        curves.append((str(label), color, ts, commanded, actual))
    return curves


def tracking(
    linkage: Linkage,
    task: CircleTask,
    solutions: Mapping[str, Solution],
    ax: Axes | None = None,
) -> Axes:
    """Paths of the tip and the path it was commanded to follow; dots are the starts.

    Into the axes of `chrono_cyclograph` it adds the path of the paper's Fig 7.

    **Arguments:** `task`: what was commanded, the tip's set point being `task.tip(t)`;
    `solutions`: one curve per label.

    **Returns:** the axes.

    **Raises:** ValueError for malformed arguments.
    """
    curves = _tips(linkage, task, solutions)
    _, _, ts, longest, _ = max(curves, key=lambda curve: len(curve[2]))
    # One turn of the circle: dashes drawn over each other become a solid line.
    turn = abs(float(getattr(task, "period", np.inf)))
    longest = longest[ts - ts[0] <= turn * (1 + 1e-6)]
    paths = [(label, color, "-", actual) for label, color, _, _, actual in curves]
    paths.append(("commanded", BLACK, "--", longest))
    ax = plane_axes(ax, np.concatenate([path for *_, path in paths]))
    for label, color, style, path in paths:
        ax.plot(*xy(path), style, color=color, lw=1.2, label=label)
        ax.plot(*xy(path[:1]), "o", color=color, markersize=4)
    legend(ax)
    return ax


def tracking_error(
    linkage: Linkage,
    task: CircleTask,
    solutions: Mapping[str, Solution],
    ax: Axes | None = None,
) -> Axes:
    """Distance of the tip from its set point over time [m].

    **Arguments:** as of `tracking`.

    **Returns:** the axes.

    **Raises:** ValueError for malformed arguments.
    """
    curves = _tips(linkage, task, solutions)
    ax = axes_or_new(ax, 2.6)
    for label, color, ts, commanded, actual in curves:
        ax.plot(ts, np.abs(actual - commanded), color=color, lw=1.2, label=label)
    ax.set(xlabel="time [s]", ylabel="tip error [m]")
    ax.set_ylim(bottom=0)
    legend(ax)
    return ax
