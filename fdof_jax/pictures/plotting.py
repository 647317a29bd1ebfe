"""Curves over time and of the tip's path, with matplotlib."""

from inspect import isfunction
from itertools import cycle

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .. import Linkage, Solution, joint_efforts, link_energies
from ..checks import instance
from ..control import controller_in
from ..forces import elements_on
from ..linkage import joint_names, moving_joints
from .arms import geometry, link_color
from .axes import (
    ACCENT,
    BLACK,
    GREY,
    LIGHT_GREY,
    SERIES,
    WIDTH,
    axes_or_new,
    figure_or_new,
    legend,
    mark_end,
    reached,
    time_panels,
)
from .energy_balance import energy_balance
from .tip_errors import tracking, tracking_by_error, tracking_error

__all__ = [
    "effort_profile", "energy_profile", "energy_stack", "motion_profile", "tracking",
    "tracking_by_error", "tracking_error",
]  # fmt: skip


# Efforts are shown larger while most of their changes are made, with some room, if that
# is a short part of the time, but of many samples.
_BUSY, _ROOM, _SHORT, _SAMPLES = (0.01, 0.85), 0.15, 0.25, 20
__dir__ = __all__.copy


def motion_profile(
    linkage: Linkage,
    solution: Solution,
    fig: Figure | None = None,
    *,
    forces: tuple = (),
    absolute: bool = False,
    title: str | None = None,
) -> Figure:
    """Plots the motion of the joints over time, and the references that they follow.

    One panel shows angles [degrees], another slides [m]. Dashed lines are references. A
    thick line, "held" in the legend, marks where something holds a joint.

    **Arguments:** `forces`: those of the solution, whose controllers have the
    references; `absolute`: whether to show the angle theta_k of each link k from the x
    axis, as in the paper's Figs 4 and 6.
    """
    ts, q, _ = reached(linkage, solution)
    instance("absolute", absolute, bool)
    if title is not None:
        instance("title", title, str)
    kinds, names = linkage.topology, joint_names(linkage)
    wanted = _references(linkage, forces, ts)
    held = np.zeros(q.shape, bool)
    if solution.modes is not None:
        held = np.asarray(solution.modes)[: len(ts)] > 0

    def shown(q: np.ndarray, k: int) -> np.ndarray:
        if kinds[k] == "P":
            return q[:, k]
        angle = geometry(linkage, q).angle[:, k + 1] if absolute else q[:, k]
        return np.rad2deg(angle)

    angle = "absolute angle [degrees]" if absolute else "angle [degrees]"
    ylabels = {"R": angle, "P": "slide [m]"}
    panels = {kind: label for kind, label in ylabels.items() if kind in kinds}
    fig, axes = time_panels(fig, 0.8 + 2.4 * len(panels), [*panels.values()])
    for ax, kind in zip(axes, panels):
        if kind == "R":
            ax.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 1.5, 3, 4.5, 9, 10]))
        joints = [k for k, one in enumerate(kinds) if one == kind]
        for k in joints:
            label = rf"$\theta_{k + 1}$" if absolute and kind == "R" else names[k]
            color, curve = link_color(k + 1), shown(q, k)
            ax.plot(ts, curve, color=color, label=label)
            for times, path in wanted:
                ax.plot(times, shown(path, k), "--", color=color, lw=1, zorder=3)
            if held[:, k].any():
                values = np.where(held[:, k], curve, np.nan)
                ax.plot(ts, values, color=color, lw=4, alpha=0.5)
        if wanted:
            ax.plot([], [], "--", color=GREY, lw=1, label="reference")
        if held[:, joints].any():
            ax.plot([], [], color=GREY, lw=4, alpha=0.5, label="held")
    mark_end(axes, solution, ts[-1])
    for ax in axes:
        legend(ax)
    if title is not None:
        fig.suptitle(title, fontsize="medium")
    return fig


def _references(
    linkage: Linkage, forces: tuple, ts: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns times and positions (time, n) of the references of all controllers.

    A reference that jumps has times at its jumps and right before them.
    """
    paths = []
    for controller in map(controller_in, elements_on(linkage, forces)):
        if controller:
            jumps = controller.jump_ts
            jumps = np.zeros(0) if jumps is None else np.ravel(jumps)
            jumps = jumps[(ts[0] < jumps) & (jumps <= ts[-1])]
            times = np.unique(np.concatenate([ts, np.nextafter(jumps, -np.inf), jumps]))
            at = lambda t, of=controller: of.schedule(t, linkage)[0]
            paths.append((times, np.asarray(jax.vmap(at)(times))))
    return paths


def energy_profile(
    linkage: Linkage, solution: Solution, fig: Figure | None = None
) -> Figure:
    """Plots kinetic and potential energy of each link and of all over time [J]."""
    ts, q, qd = reached(linkage, solution)
    energies = jax.vmap(lambda q, qd: link_energies(linkage, q, qd))(q, qd)
    kinetic, potential = map(np.asarray, energies)
    quantities = "kinetic energy", "potential energy", "energy of all links"
    fig, axes = time_panels(fig, 6.0, [f"{name} [J]" for name in quantities])
    for ax, of_links in zip(axes, (kinetic, potential)):
        for k, values in enumerate(of_links.T, start=1):
            ax.plot(ts, values, color=link_color(k), label=f"link {k}")
    sums = kinetic.sum(axis=1), potential.sum(axis=1), (kinetic + potential).sum(axis=1)
    names = "kinetic", "potential", "total"
    for values, label, color in zip(sums, names, (*SERIES[3:5], BLACK)):
        axes[2].plot(ts, values, color=color, label=label)
    mark_end(axes, solution, ts[-1])
    legend(axes[0])
    legend(axes[2])
    return fig


def energy_stack(
    linkage: Linkage, forces: tuple, solution: Solution, ax: Axes | None = None
) -> Axes:
    """Plots the energy balance over time, stacked [J].

    The stack is kinetic energy, potential energy above its least, and the energy that
    the forces have taken out since the start. The dashed line is the energy at the
    start plus what the forces have put in. The top of the stack leaves this line where
    samples are too far apart for the trapezoidal rule: near contacts, jumps and delayed
    commands.

    An element puts energy in while its power is positive, and takes it out while it is
    negative. What friction, impacts, brakes and catches take is exact:
    `solution.taken`. Masses that come and go bring and take their energy; heights count
    from the ground pivot.
    """
    ts, bands, line = energy_balance(linkage, forces, solution)
    driven = np.ptp(line) > 1e-3 * line.max()  # more than errors of the work
    ax = axes_or_new(ax, 2.6)
    colors = [*SERIES[3:5], LIGHT_GREY]
    ax.stackplot(ts, list(bands.values()), labels=list(bands), colors=colors)
    label = "start + put in" if driven else "at the start"
    ax.plot(ts, line, "--", color=BLACK, label=label)
    ax.set(xlabel="time [s]", ylabel="energy [J]", xlim=(ts[0], ts[-1]))
    mark_end([ax], solution, ts[-1])
    legend(ax)
    return ax


def effort_profile(
    linkage: Linkage, forces: tuple, solution: Solution, fig: Figure | None = None
) -> Figure:
    """Plots the efforts of each element over time, a panel per joint [N or N m].

    A grey band shows a controller's finite limits where the efforts come near them; the
    label gives all limits. Orange dots mark samples at a limit. If nearly all changes
    come in a short time, panels on the left enlarge it.
    """
    last = reached(linkage, solution)[0][-1]
    efforts = joint_efforts(linkage, forces, solution)
    ts, total, parts = (np.asarray(a) for a in (solution.ts, *efforts))
    moving, joints = moving_joints(linkage), joint_names(linkage)
    controllers = [controller_in(element) for element in elements_on(linkage, forces)]
    parts, held = [*parts], solution.acting is not None
    named = [(name, part) for name, part in zip(_names(forces), parts) if part.any()]
    named = named or [("none", total)]
    busy = _busy(ts, np.stack([part for _, part in named]))
    columns = 1 if busy is None else 2
    fig = figure_or_new(fig, WIDTH, 1.0 + 1.4 * len(moving))
    table = fig.subplots(
        len(moving), columns, squeeze=False, sharex="col", sharey="row",
        width_ratios=[1, 1.4][-columns:],
    )  # fmt: skip
    for k, row in zip(moving, table):
        unit = "N m" if joints[k][0] == "R" else "N"
        own = [
            (float(controller.limit[k]), part[:, k])
            for controller, part in zip(controllers, parts)
            if controller and np.isfinite(controller.limit[k])
        ]
        most = "".join(f"\nlimit ±{limit:g}" for limit, _ in own)
        row[0].set_ylabel(f"{joints[k]} [{unit}]{most}")
        for ax in row:
            ax.spines[["top", "right"]].set_visible(False)
            for (name, part), color in zip(named, cycle((SERIES[0], *SERIES[2:]))):
                (line,) = ax.plot(ts, part[:, k], color=color, label=name)
                if held and part is parts[0]:
                    line.set_drawstyle("steps-post")
        low, high = row[-1].get_ylim()  # before the bands, which may be far wider
        for limit, effort in own:
            at = (np.abs(effort) >= limit) & (effort != 0)
            for ax in row:
                dots = ax.plot(ts[at], effort[at], ".", color=ACCENT, zorder=3)
                name = "saturated" if at.any() else None
                dots[0].set(label=name, gid=f"saturated {k + 1}")
            if at.any():
                low, high = min(low, -1.1 * limit), max(high, 1.1 * limit)
        row[-1].set_ylim(low, high)
        for limit in {limit for limit, _ in own if limit < max(-low, high)}:
            for ax in row:
                ax.axhspan(-limit, limit, color=GREY, alpha=0.15, lw=0, label="limits")
    if busy is not None:
        table[0, 0].set_xlim(busy)
    mark_end(table[:, -1], solution, last)
    for ax in table[-1]:
        ax.set_xlabel("time [s]")
    fig.align_ylabels(table[:, 0])
    legend(table[0, -1], *table.ravel())
    return fig


def _names(forces: tuple) -> list[str]:
    return [f.__name__ if isfunction(f) else type(f).__name__ for f in forces]


def _busy(ts: np.ndarray, efforts: np.ndarray) -> tuple[float, float] | None:
    """Returns a short part of the time in which nearly all changes are, if any."""
    moves = np.abs(np.diff(efforts, axis=1))
    moves = moves / np.maximum(np.ptp(efforts, axis=1, keepdims=True), 1e-300)
    done = np.nan_to_num(moves).sum(axis=(0, 2)).cumsum()
    if not done.size or not done[-1]:
        return None
    first, last = np.searchsorted(done, np.array(_BUSY) * done[-1])
    begin, end = ts[first], ts[last + 1]
    room = _ROOM * (end - begin)
    long = end - begin + 2 * room > _SHORT * (ts[-1] - ts[0])
    if long or last - first < _SAMPLES:
        return None
    return float(max(begin - room, ts[0])), float(min(end + room, ts[-1]))
