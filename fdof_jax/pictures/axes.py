"""Colours, figures, axes, legends and argument checks of all pictures."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .. import Linkage, Solution
from ..checks import check_joints, check_linkage, refusal

Keywords = dict[str, Any]  # of functions of matplotlib
# Okabe and Ito's colours, distinct under the common kinds of colour blindness.
BLACK, GREY, LIGHT_GREY = "#000000", "#808080", "#BBBBBB"
SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
ACCENT = SERIES[1]  # of the tip, its path, and what happens to a motion
WIDTH = 6.4  # of a new figure [inches]


def reached(
    linkage: Linkage, solution: Solution, name: str = "solution"
) -> list[np.ndarray]:
    """Arrays `ts`, `q` and `qd` of one solution, up to the last time reached."""
    check_linkage(linkage)
    if not isinstance(solution, Solution) or np.ndim(solution.q) != 2:
        expected = "the Solution of one motion (of a batch, pass one member)"
        raise refusal(name, expected, solution)
    check_joints(name, solution, linkage)
    arrays = [np.asarray(a) for a in (solution.ts, solution.q, solution.qd)]
    finite = np.isfinite(arrays[1]).all(axis=1)
    if not finite.any():
        raise refusal(name, "at least one finite sample", solution)
    return [array[finite] for array in arrays]


def ending(solution: Solution) -> str:
    """A legend of when and why a motion ended early; "" if it did not."""
    finite = np.isfinite(np.asarray(solution.q)).all(axis=1)
    if finite.all():
        return ""
    last = np.asarray(solution.ts)[finite][-1]
    return f"ended at {last:.3g} s:\n{solution.outcome}"


def mark_end(axes: Iterable[Axes], solution: Solution, last: float) -> None:
    """Marks the last time reached if a motion ended early."""
    if text := ending(solution):
        for ax in axes:
            ax.axvline(last, color=ACCENT, ls=":", lw=1.2, label=text, gid="end")
            ax.set_xlim(right=float(solution.ts[-1]))


def filled_mapping(name: str, value: object, kind: str) -> Mapping:
    """Returns `value` if it is a nonempty dictionary, else raises ValueError."""
    if not isinstance(value, Mapping) or not value:
        raise refusal(name, f"a non-empty dictionary of label: {kind}", value)
    return value


def figure_or_new(fig: Figure | None, width: float, height: float) -> Figure:
    """Returns `fig`, or a new figure of the given size [inches]."""
    if fig is None:
        return plt.figure(figsize=(width, height), layout="compressed")
    if not isinstance(fig, Figure):
        raise refusal("fig", "a matplotlib Figure or None", fig)
    return fig


def axes_or_new(ax: Axes | None, height: float, width: float = WIDTH) -> Axes:
    """Returns `ax`, or the axes of a new figure of the given size [inches]."""
    if ax is None:
        ax = figure_or_new(None, width, height).subplots()
    if not isinstance(ax, Axes):
        raise refusal("ax", "matplotlib Axes or None", ax)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def time_panels(
    fig: Figure | None, height: float, ylabels: Sequence[str]
) -> tuple[Figure, list[Axes]]:
    """Stacks axes over time; a new figure has the given `height` [inches]."""
    fig = figure_or_new(fig, WIDTH, height)
    axes = list(fig.subplots(len(ylabels), squeeze=False, sharex=True)[:, 0])
    for ax, ylabel in zip(axes, ylabels):
        ax.set_ylabel(ylabel)
        ax.spines[["top", "right"]].set_visible(False)
        ax.margins(x=0)
    axes[-1].set_xlabel("time [s]")
    axes[-1].locator_params("x", nbins=6)
    fig.align_ylabels(axes)
    return fig, axes


def xy(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates x and y of complex points."""
    return np.real(points).ravel(), np.imag(points).ravel()


def plane_axes(
    ax: Any, points: np.ndarray, *, width: float = WIDTH, beside: float = 0.0
) -> Axes:
    """Axes of equal scales; a new figure gets the proportions of the points.

    `beside`: part of its `width` for a legend or a scale [inches].
    """
    corners = [part[~np.isnan(part)] for part in xy(points)]  # NaN lifts the pen
    low, high = (np.array([end(part) for part in corners]) for end in (np.min, np.max))
    # A straight arm has room around it.
    room = np.maximum(0.4 * max(*(high - low), 1e-9) - (high - low), 0) / 2
    low, high = low - room, high + room
    across, up = high - low
    inside = 1.1 * (width - beside - 0.7) * up / across
    ax = axes_or_new(ax, 1.0 + np.clip(inside, 0.3 * width, 0.75 * width), width)
    ax.update_datalim([low, high])
    ax.set_aspect("equal")
    across, up = ax.margins()  # of what is drawn there
    ax.margins(max(across, 0.1), max(up, 0.16))  # below, the ground needs room
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.locator_params(steps=[1, 2, 5, 10])
    ax.locator_params("y", nbins=6)  # as coarse as x
    return ax


def figure_of(ax: Axes) -> Figure:
    figure = ax.get_figure(root=True)
    assert figure is not None  # axes are always in a figure
    return figure


def _entries(axes: Iterable[Axes]) -> dict[str, Artist]:
    """Handles of a legend by label; of equal labels, the last one's."""
    entries = {}
    for ax in axes:
        handles, labels = ax.get_legend_handles_labels()
        entries |= dict(zip(labels, handles))
    return entries


_LEGEND: Keywords = dict(frameon=False, handlelength=1.2)


def legend(ax: Axes, *others: Axes) -> None:
    """Adds a legend of all labels above the axes."""
    entries, figure = _entries((ax, *others)), figure_of(ax)
    figure.draw_without_rendering()  # with what was drawn since the last layout
    for rows in range(1, len(entries) + 1):
        drawn = ax.legend(
            entries.values(), entries.keys(), ncols=-(-len(entries) // rows),
            columnspacing=1.2, loc="lower left", bbox_to_anchor=(0, 1),
            borderaxespad=0.2, **_LEGEND,
        )  # fmt: skip
        # Equal scales shrink the axes after a layout, so that one alone cuts labels.
        figure.draw_without_rendering()
        right = ax.get_position(original=True).x1 * figure.bbox.x1
        if drawn.get_window_extent().x1 <= right:
            return


def figure_legend(fig: Figure) -> None:
    """Adds or replaces a legend of all labels in the figure, beside its axes."""
    for old in fig.legends:
        old.remove()
    entries = _entries(fig.axes)
    fig.legend(entries.values(), entries.keys(), loc="outside right upper", **_LEGEND)
