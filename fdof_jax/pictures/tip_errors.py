"""Pictures of the tip's path and its distance from the commanded one."""

from collections.abc import Mapping
from itertools import cycle
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap

from .. import CircleTask, Linkage, Solution, TipTask
from ..checks import refusal, shown
from ..references import Laps, Reference, reference_of
from .arms import geometry
from .axes import (
    SERIES,
    axes_or_new,
    ending,
    filled_mapping,
    legend,
    plane_axes,
    reached,
    xy,
)  # fmt: skip
from .elements import COMMANDED

_TIPS = [SERIES[k] for k in (1, 3, 4, 0, 2, 5)]  # first those of no early link
# Without the lightest colours, which are hard to see on white.
_DARK_TO_LIGHT = ListedColormap(colormaps["plasma"](np.linspace(0, 0.85, 256)))


class _Tip(NamedTuple):
    """Times [s] and positions x + iy of a tip [m]: (time,)."""

    ts: np.ndarray
    commanded: np.ndarray
    path: np.ndarray


def _tip(
    linkage: Linkage, task: Reference, solution: Solution, name: str = "solution"
) -> _Tip:
    if not callable(task) or (tip := reference_of(task).tip) is None:
        raise refusal("task", "a CircleTask or a TipTask", task)
    ts, q, _ = reached(linkage, solution, name)
    commanded = np.asarray(jax.vmap(tip)(jnp.asarray(ts))) @ [1, 1j]
    return _Tip(ts, commanded, geometry(linkage, q).tip)


def _tips(
    linkage: Linkage, task: Reference, solutions: Mapping[str, Solution]
) -> dict[str, _Tip]:
    filled_mapping("solutions", solutions, "Solution")
    tips = {}
    for label, solution in solutions.items():
        tip = _tip(linkage, task, solution, f"solutions[{shown(label)}]")
        end = ending(solution)
        tips[f"{label}, {end}" if end else label] = tip
    return tips


def _draw_commanded(
    ax: Axes, task: Reference, ts: np.ndarray, path: np.ndarray
) -> None:
    """Draws one turn of the commanded path, dashed, above the others."""
    # Dashes of a second turn would fill the gaps of the first.
    turning = task.timing if isinstance(task, TipTask) else task
    if isinstance(turning, CircleTask | Laps):
        path = path[ts <= ts[0] + abs(turning.period)]
    ax.plot(*xy(path), label="commanded", zorder=3, **COMMANDED)


def tracking(
    linkage: Linkage,
    task: Reference,
    solutions: Mapping[str, Solution],
    ax: Axes | None = None,
) -> Axes:
    """Plots paths of the tip with the commanded path, dashed; dots are the starts.

    In the axes of `chrono_cyclograph` it completes the paper's Fig 7. Label the motion
    "tip" there, because its path is drawn already.

    **Arguments:** `task`: a `CircleTask` or a `TipTask`, whose `tip(t)` is the
    commanded position [m]; `solutions`: one curve per label.
    """
    tips = _tips(linkage, task, solutions)
    ts, longest, _ = max(tips.values(), key=lambda tip: len(tip.ts))
    paths = {label: tip.path for label, tip in tips.items()}
    ax = plane_axes(ax, np.concatenate([longest, *paths.values()]))
    _draw_commanded(ax, task, ts, longest)
    for (label, path), color in zip(paths.items(), cycle(_TIPS)):
        (line,) = ax.plot(*xy(path), color=color, label=label, zorder=3)
        line.set(marker="o", ms=4, markevery=[0])
    legend(ax)
    return ax


def tracking_by_error(
    linkage: Linkage, task: Reference, solution: Solution, ax: Axes | None = None
) -> Axes:
    """Plots the path of the tip, coloured by its distance from its set point [mm].

    The commanded path is dashed; a cross marks the tip's start. Later turns cover
    earlier ones.
    """
    ts, commanded, path = _tip(linkage, task, solution)
    error = 1000 * np.abs(path - commanded)
    ax = plane_axes(ax, np.concatenate([commanded, path]), beside=0.8)
    corners = np.column_stack(xy(path))
    pieces = LineCollection(
        list(np.stack([corners[:-1], corners[1:]], axis=1)),
        array=(error[:-1] + error[1:]) / 2, cmap=_DARK_TO_LIGHT, lw=2, capstyle="round",
    )  # fmt: skip
    pieces.set_clim(0, error.max())
    ax.add_collection(pieces)
    ax.autoscale_view()
    color = _DARK_TO_LIGHT(pieces.norm(error[0]))
    ax.plot(*corners[0], "x", color=color, ms=5, label="start")
    _draw_commanded(ax, task, ts, commanded)
    # An inset is as high as the axes, which equal scales may shrink.
    bar = ax.inset_axes((1.04, 0, 0.05, 1))
    ax.figure.colorbar(pieces, cax=bar, label="tip error [mm]")
    legend(ax)
    return ax


def tracking_error(
    linkage: Linkage,
    task: Reference,
    solutions: Mapping[str, Solution],
    ax: Axes | None = None,
) -> Axes:
    """Plots the distance of the tip from its set point over time [m].

    **Arguments:** as in `tracking`.
    """
    tips = _tips(linkage, task, solutions)
    ax = axes_or_new(ax, 2.6)
    for (label, tip), color in zip(tips.items(), cycle(_TIPS)):
        error = np.abs(tip.path - tip.commanded)
        ax.plot(tip.ts, error, color=color, label=label)
    ax.set(xlabel="time [s]", ylabel="tip error [m]")
    ax.set_ylim(bottom=0)
    legend(ax)
    return ax
