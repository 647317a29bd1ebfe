"""Pictures and animations of linkages in the plane, with matplotlib.

Every function draws into the axes (`ax`) or figure (`fig`) it is given, or into a new
one, and returns it; `animate` and `animate_grid` return their animation. Nothing is
shown or saved, and no global setting changes. A `solution` is that of one `simulate`;
what a failed one did not reach is left out. Links are numbered as in the paper: the
ground is link 1, the moving ones are 2 to 4. Curves over time are in `plotting`.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from numpy.typing import ArrayLike

from ..checks import real_array, whole_number
from ..linkage.linkage import Linkage
from ..simulation.solution import Solution
from .axes import (
    BLACK,
    GREY,
    SERIES,
    figure_or_new,
    filled_mapping,
    legend,
    plane_axes,
    reached,
    refuse,
    xy,
)
from .geometry import Geometry, geometry

_LINKS = (BLACK, *SERIES[:3])

# Markers, in points: a carriage on a piece of its rail, a bearing on hatched ground.
# Path codes: 1 moves the pen, 2 draws a line, 79 closes the outline.
_BOX = [(-0.55, -0.35), (0.55, -0.35), (0.55, 0.35), (-0.55, 0.35), (0, 0)]
_CARRIAGE = Path([(-1, 0), (1, 0), *_BOX], [1, 2, 1, 2, 2, 2, 79])
_HATCH = [p for x in (-0.9, -0.45, 0, 0.45) for p in ((x, -1), (x + 0.3, -0.7))]
_BEARING = Path(
    [(0, 0), (-0.5, -0.7), (0.5, -0.7), (0, 0), (-0.9, -0.7), (0.9, -0.7), *_HATCH],
    [1, 2, 2, 79] + [1, 2] * 5,
)
_STYLES: dict[str, dict[str, Any]] = {
    "link": dict(lw=2.2, solid_capstyle="round", solid_joinstyle="round"),
    "rail": dict(lw=0.9),
    "mass": dict(lw=0.6, marker="o", markersize=4, markevery=[1]),
    "pin": dict(marker="o", markersize=4.5, mfc="white"),
    "slider": dict(markersize=15, mfc="white", mew=0.9),
    "tip": dict(marker="s", markersize=3.5),
}


def _place(lines: dict[str, Line2D], g: Geometry, i: int) -> None:
    """Move the lines to sample `i`."""
    for name, line in lines.items():
        line.set_data(*xy(g.points[name][i]))
        if name.startswith("slider"):
            across = g.angle[i, int(name[-1]) - 1] + np.pi / 2
            marker = MarkerStyle(_CARRIAGE).rotated(rad=across)
            line.set_marker(marker)  # type: ignore[arg-type]


def _draw(
    ax: Axes,
    g: Geometry,
    i: int,
    mass_centers: bool,
    alpha: float = 1.0,
    color: Any = None,
    label: bool = True,
) -> dict[str, Line2D]:
    """Lines of sample `i` by name, which is also their `gid`."""
    lines = {}
    for name, points in g.points.items():
        kind, number = name.split()
        if kind == "mass" and not mass_centers:
            continue
        own = BLACK if kind == "pin" else _LINKS[int(number) - 1]
        (lines[name],) = ax.plot(*xy(points[i]), alpha=alpha, gid=name)
        lines[name].set(color=own if color is None else color, **_STYLES[kind])
        if name == "link 1":
            lines[name].set_linewidth(1.2)
        elif kind == "link" and label:
            lines[name].set_label(name)
    _place(lines, g, i)
    return lines


def _draw_ground(ax: Axes) -> None:
    ground = ax.plot(0, 0, marker=_BEARING, markersize=18, zorder=1, gid="ground")[0]
    ground.set(mfc="white", mec=GREY, mew=0.8, clip_on=False)


class DrawnMotion(NamedTuple):
    """The lines of `draw_motion`."""

    path: Line2D
    arms: list[dict[str, Line2D]]

    def move(self, g: Geometry, indices: np.ndarray) -> None:
        """To another motion of an arm of the same topology, as many samples of it."""
        self.path.set_data(*xy(g.end[: indices[-1] + 1, 3]))
        for lines, i in zip(self.arms, indices):
            _place(lines, g, i)


def draw_motion(
    ax: Axes, g: Geometry, indices: np.ndarray, mass_centers: bool
) -> DrawnMotion:
    """The path of the tip to the last of the samples, and these from faint to full."""
    _draw_ground(ax)
    path = g.end[: indices[-1] + 1, 3]
    (path,) = ax.plot(*xy(path), color=GREY, lw=1, label="tip path", gid="tip path")
    arms = [
        _draw(ax, g, i, mass_centers, float(alpha), label=i == indices[-1])
        for i, alpha in zip(indices, np.linspace(1, 0.15, len(indices))[::-1])
    ]
    return DrawnMotion(path, arms)


def draw_linkage(
    linkage: Linkage,
    q: ArrayLike,
    ax: Axes | None = None,
    *,
    color: Any = None,
    alpha: float = 1.0,
    mass_centers: bool = True,
) -> Axes:
    """One configuration, to scale.

    A link is a line along its vector A_n, bent by the fixed B_n where the next joint is
    revolute. Real revolute joints are pins; real prismatic joints are carriages on a
    rail of length B_n. Fictitious joints are not drawn. The tip is a square, a mass
    centre is a dot, joined to its link if it lies beside it.

    **Arguments:** `q`: joint positions [m or rad]; `color`: one for all links, by
    default each has its own; `alpha`: opacity, 0 to 1; `mass_centers`: whether to draw
    them.

    **Returns:** the axes. The `gid` of a line says what it is: "link 2", "pin 1",
    "rail 2", "slider 2", "mass 3", "tip 4", "ground".

    **Raises:** ValueError for malformed arguments.
    """
    g = geometry(linkage, np.asarray(real_array("q", q, (3,)))[None])
    ax = plane_axes(ax, np.hstack(list(g.points.values())))
    _draw_ground(ax)
    _draw(ax, g, 0, mass_centers, alpha, color)
    return ax


def chrono_cyclograph(
    linkage: Linkage,
    solution: Solution,
    ax: Axes | None = None,
    *,
    every: float = 0.1,
    until: float | None = None,
    mass_centers: bool = False,
) -> Axes:
    """Configurations at equal time steps, from faint to full, and the path of the tip.

    As in the paper's Figs 3, 5 and 7.

    **Arguments:** `every`: time step, of which the nearest samples are drawn [s];
    `until`: last time, by default the solution's [s]; `mass_centers`: whether to draw
    them.

    **Returns:** the axes.

    **Raises:** ValueError for malformed arguments and for an `until` before the start.
    """
    ts, q, _ = reached(solution)
    g = geometry(linkage, q)
    step = float(real_array("every", every, (), above=0))
    last = ts[-1]
    if until is not None:
        last = min(last, float(real_array("until", until, (), minimum=float(ts[0]))))
    # The excess keeps the last step where the division falls short by rounding.
    steps = np.arange(np.floor((last - ts[0]) / step + 1e-6) + 1)
    indices = np.unique([np.abs(ts - t).argmin() for t in ts[0] + step * steps])
    ax = plane_axes(ax, g.end[: indices[-1] + 1])
    draw_motion(ax, g, indices, mass_centers)
    legend(ax)
    return ax


def _geometries(motions: Any) -> dict[str, tuple[np.ndarray, Geometry]]:
    """Per title the times and the geometry of a motion."""
    filled_mapping("motions", motions, "(Linkage, Solution)")
    found = {}
    for title, pair in motions.items():
        name = f"motions[{title!r}]"
        fits = isinstance(pair, tuple) and len(pair) == 2
        if not (fits and isinstance(pair[0], Linkage)):
            raise refuse(name, "(Linkage, Solution)", pair)
        ts, q, _ = reached(pair[1], name)
        found[title] = ts, geometry(pair[0], q)
    return found


def _panels(
    geometries: dict[str, tuple[np.ndarray, Geometry]], fig: Figure | None
) -> tuple[Figure, list[Axes]]:
    """A grid of axes, one per motion."""
    columns = min(4, len(geometries))
    rows = -(-len(geometries) // columns)
    fig = figure_or_new(fig, 0.3 + 1.75 * columns, 0.4 + 1.9 * rows)
    panels = []
    for position, (title, (_, g)) in enumerate(geometries.items()):
        ax = plane_axes(fig.add_subplot(rows, columns, position + 1), g.end)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(title=title, xlabel="", ylabel="")
        ax.tick_params(labelsize="small")
        panels.append(ax)
    fig.supxlabel("x [m]", fontsize="medium")
    fig.supylabel("y [m]", fontsize="medium")
    return fig, panels


def topology_grid(
    motions: Mapping[str, tuple[Linkage, Solution]],
    fig: Figure | None = None,
    *,
    configurations: int = 3,
) -> Figure:
    """Linkages side by side, each with a few configurations and the path of its tip.

    **Arguments:** `motions`: title -> (linkage, its solution); `configurations`: how
    many of each, evenly spaced in samples from the first (faint) to the last.

    **Returns:** the figure.

    **Raises:** ValueError for malformed arguments.
    """
    whole_number("configurations", configurations, 2)
    geometries = _geometries(motions)
    fig, panels = _panels(geometries, fig)
    for ax, (ts, g) in zip(panels, geometries.values()):
        indices = np.linspace(0, len(ts) - 1, configurations).round().astype(int)
        draw_motion(ax, g, np.unique(indices), mass_centers=False)
    return fig


class _Animation(FuncAnimation):
    """One that a notebook plays where it is the last line of a cell."""

    def __init__(self, figure: Figure, *args: Any, **kwargs: Any):
        super().__init__(figure, *args, **kwargs)
        self._figure = figure

    def to_jshtml(self, *args: Any, **kwargs: Any) -> str:
        plt.close(self._figure)  # or a notebook shows it again, standing still
        return super().to_jshtml(*args, **kwargs)

    def __repr__(self) -> str:
        return "an animation"  # an address would differ in each run of a notebook

    def _repr_html_(self) -> str:
        return self.to_jshtml()


def _frame_times(
    timelines: list[np.ndarray], fps: ArrayLike, speed: ArrayLike, max_frames: int
) -> tuple[np.ndarray, float]:
    """The times that frames show, and the pause between two of them [ms]."""
    fps = float(real_array("fps", fps, (), above=0))
    speed = float(real_array("speed", speed, (), above=0))
    begin, end = min(ts[0] for ts in timelines), max(ts[-1] for ts in timelines)
    duration = (end - begin) / speed
    most = whole_number("max_frames", max_frames, 1)
    frames = min(most, int(np.ceil(duration * fps)) + 1)
    pause = duration / (frames - 1) if frames > 1 else 1 / fps
    return np.linspace(begin, end, frames), 1000 * pause


def _animation(
    panels: list[Axes],
    motions: list[tuple[np.ndarray, Geometry]],
    times: np.ndarray,
    pause: float,
    say: Callable[..., Any],
    new: bool,
) -> FuncAnimation:
    """The motions in the panels of a figure, `new` or given; `say` writes the time."""
    moving = []
    for ax, (ts, g) in zip(panels, motions):
        _draw_ground(ax)
        points = np.hstack(list(g.points.values()))
        (trace,) = ax.plot(*xy(points), color=GREY, lw=1, gid="tip path")
        lines = _draw(ax, g, 0, mass_centers=True)
        samples = np.array([np.abs(ts - t).argmin() for t in times])
        moving.append((g, DrawnMotion(trace, [lines]), samples))

    def show(frame: int) -> list[Line2D]:
        for g, drawn, samples in moving:
            drawn.move(g, samples[frame : frame + 1])
        say(f"t = {times[frame]:.2f} s", fontsize="medium")
        return [
            line for _, (path, (arm,)), _ in moving for line in (path, *arm.values())
        ]

    figure = panels[0].get_figure(root=True)
    assert figure is not None  # axes are always in a figure
    say("t = 0 s", fontsize="medium")
    figure.draw_without_rendering()
    for ax in panels:
        ax.autoscale(False)  # at limits that hold all samples
        ax.set_adjustable("box")
    if new:
        figure.set_layout_engine("none")  # a layout per frame takes half the time
    show(0)
    return _Animation(figure, show, len(times), interval=pause, cache_frame_data=False)


def animate(
    linkage: Linkage,
    solution: Solution,
    ax: Axes | None = None,
    *,
    fps: float = 25,
    speed: float = 1.0,
    max_frames: int = 250,
) -> FuncAnimation:
    """The motion as an animation, with the path of the tip so far.

    A frame shows the nearest sample. A motion that would need more than `max_frames` is
    shown in fewer frames a second.

    **Arguments:** `fps`: frames a second; `speed`: 2 shows the motion twice as fast.

    **Returns:** the animation, which a notebook plays where it ends a cell. Keep it
    until it is shown. `.save("motion.gif")` and `.save("motion.mp4")` write it, the
    latter with ffmpeg; `.to_jshtml()` is a player as text, to be put in a web page.

    **Raises:** ValueError for malformed arguments.
    """
    ts, q, _ = reached(solution)
    times, pause = _frame_times([ts], fps, speed, max_frames)
    g = geometry(linkage, q)
    panel = plane_axes(ax, np.hstack(list(g.points.values())))
    return _animation([panel], [(ts, g)], times, pause, panel.set_title, ax is None)


def animate_grid(
    motions: Mapping[str, tuple[Linkage, Solution]],
    fig: Figure | None = None,
    *,
    fps: float = 25,
    speed: float = 1.0,
    max_frames: int = 250,
) -> FuncAnimation:
    """Linkages side by side, moving at the same time; one that has ended stands still.

    **Arguments:** `motions`: title -> (linkage, its solution); the others as in
    `animate`.

    **Returns:** the animation, as of `animate`.

    **Raises:** ValueError for malformed arguments.
    """
    geometries = _geometries(motions)
    shown = list(geometries.values())
    times, pause = _frame_times([ts for ts, _ in shown], fps, speed, max_frames)
    figure, panels = _panels(geometries, fig)
    return _animation(panels, shown, times, pause, figure.suptitle, fig is None)
