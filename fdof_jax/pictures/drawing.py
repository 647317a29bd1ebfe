"""Pictures and animations of linkages in the plane, with matplotlib.

Every function draws into the given axes (`ax`) or figure (`fig`), or into a new one,
and returns it; `animate` and `animate_grid` return an animation. Nothing is shown or
saved, and no global setting changes. A `solution` is that of one `simulate`; of a
failed one, the samples reached are drawn. Link 0 is the ground, links 1, 2, ... move.
Malformed arguments raise ValueError. Curves over time are in `plotting`.
"""

from collections.abc import Callable, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from ..checks import real_array, whole_number
from ..linkage.linkage import Linkage, check_linkage, per_joint
from ..simulation.solution import Solution
from .arms import (
    Geometry,
    draw_arm,
    draw_ground,
    draw_motion,
    geometries_of,
    geometry,
    panels_of,
)
from .axes import BLACK, GREY, SERIES, legend, plane_axes, reached, xy

__all__ = [
    "BLACK", "GREY", "SERIES", "animate", "animate_grid", "chrono_cyclograph",
    "draw_linkage", "topology_grid",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


def draw_linkage(
    linkage: Linkage,
    q: ArrayLike,
    ax: Axes | None = None,
    *,
    color: Any = None,
    alpha: float = 1.0,
    mass_centers: bool = True,
) -> Axes:
    """Draws one configuration, to scale.

    A link is a line along its vector A, bent by the fixed B where the next joint is
    revolute. Real revolute joints are pins; real prismatic joints are carriages on a
    rail of length B. Fictitious joints are not drawn. The tip is a square. A mass
    centre is a dot, joined to its link if it lies beside it.

    **Arguments:** `q`: joint positions [m or rad]; `color`: common colour of all links,
    by default one per link; `alpha`: opacity, 0 to 1; `mass_centers`: whether to draw
    them.

    **Returns:** the axes. The `gid` of a line names its part: "link 1", "pin 1",
    "rail 2", "slider 2", "mass 3", "tip 3", "ground".
    """
    check_linkage(linkage)
    g = geometry(linkage, np.asarray(per_joint("q", q, linkage))[None])
    ax = plane_axes(ax, g.all_points)
    draw_ground(ax)
    draw_arm(ax, g, 0, mass_centers, alpha, color)
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
    """Draws configurations at equal time steps, from faint to full, and the tip's path.

    The picture is that of the paper's Figs 3, 5 and 7.

    **Arguments:** `every`: time step [s], at which the nearest samples are drawn;
    `until`: last time, by default the solution's [s]; `mass_centers`: whether to draw
    them.

    **Raises:** ValueError for malformed arguments and for an `until` before the start.
    """
    ts, q, _ = reached(linkage, solution)
    g = geometry(linkage, q)
    step = float(real_array("every", every, (), above=0))
    last = ts[-1]
    if until is not None:
        last = min(last, float(real_array("until", until, (), minimum=float(ts[0]))))
    # The added 1e-6 keeps the last step if the division falls short by rounding.
    steps = np.arange(np.floor((last - ts[0]) / step + 1e-6) + 1)
    indices = np.unique([np.abs(ts - t).argmin() for t in ts[0] + step * steps])
    ax = plane_axes(ax, g.all_points[: indices[-1] + 1])
    draw_motion(ax, g, indices, mass_centers)
    legend(ax)
    return ax


def topology_grid(
    motions: Mapping[str, tuple[Linkage, Solution]],
    fig: Figure | None = None,
    *,
    configurations: int = 3,
) -> Figure:
    """Draws linkages side by side, each with a few configurations and its tip's path.

    **Arguments:** `motions`: title -> (linkage, its solution); `configurations`: number
    for each, evenly spaced in samples from the first (faint) to the last.
    """
    whole_number("configurations", configurations, 2)
    geometries = geometries_of(motions)
    fig, panels = panels_of(geometries, fig)
    for ax, (ts, g) in zip(panels, geometries.values()):
        indices = np.linspace(0, len(ts) - 1, configurations).round().astype(int)
        draw_motion(ax, g, np.unique(indices), mass_centers=False)
    return fig


class _Animation(FuncAnimation):
    """An animation that a notebook plays if it is the last line of a cell."""

    def __init__(self, figure: Figure, *args: Any, **kwargs: Any):
        super().__init__(figure, *args, **kwargs)
        self._figure = figure

    def to_jshtml(self, *args: Any, **kwargs: Any) -> str:
        plt.close(self._figure)  # otherwise a notebook also shows the still figure
        return super().to_jshtml(*args, **kwargs)

    def __repr__(self) -> str:
        return "an animation"  # without an address, the same in each run of a notebook

    def _repr_html_(self) -> str:
        return self.to_jshtml()


def _frame_times(
    timelines: list[np.ndarray], fps: ArrayLike, speed: ArrayLike, max_frames: int
) -> tuple[np.ndarray, float]:
    """Times of the frames, and the pause between two frames [ms]."""
    fps = float(real_array("fps", fps, (), above=0))
    speed = float(real_array("speed", speed, (), above=0))
    most = whole_number("max_frames", max_frames, 1)
    begin, end = min(ts[0] for ts in timelines), max(ts[-1] for ts in timelines)
    duration = (end - begin) / speed
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
    """Animates motions in panels of a `new` or given figure; `say` writes the time."""
    moving = []
    for ax, (ts, g) in zip(panels, motions):
        samples = np.array([np.abs(ts - t).argmin() for t in times])
        moving.append((g, draw_motion(ax, g, samples[:1], mass_centers=True), samples))
        ax.update_datalim(np.column_stack(xy(g.all_points)))  # of all samples

    def show(frame: int) -> None:
        for g, drawn, samples in moving:
            drawn.move(g, samples[frame : frame + 1])
        say(f"t = {times[frame]:.2f} s", fontsize="medium")

    show(0)
    figure = panels[0].get_figure(root=True)
    assert figure is not None  # axes are always in a figure
    figure.draw_without_rendering()
    for ax in panels:
        ax.autoscale(False)
        ax.set_adjustable("box")
    if new:
        figure.set_layout_engine("none")  # a layout per frame takes half the time
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
    """Animates a motion, with the path of the tip so far.

    Each frame shows the nearest sample. If a motion needs more than `max_frames`, it is
    shown with fewer frames per second.

    **Arguments:** `fps`: frames per second; `speed`: 2 shows the motion twice as fast.

    **Returns:** the animation; a notebook plays it if it is the last line of a cell.
    Keep it until it is shown. `.save("motion.gif")` and `.save("motion.mp4")` write it,
    the latter with ffmpeg; `.to_jshtml()` returns a player as text, for a web page.
    """
    ts, q, _ = reached(linkage, solution)
    times, pause = _frame_times([ts], fps, speed, max_frames)
    g = geometry(linkage, q)
    panel = plane_axes(ax, g.all_points)
    return _animation([panel], [(ts, g)], times, pause, panel.set_title, ax is None)


def animate_grid(
    motions: Mapping[str, tuple[Linkage, Solution]],
    fig: Figure | None = None,
    *,
    fps: float = 25,
    speed: float = 1.0,
    max_frames: int = 250,
) -> FuncAnimation:
    """Animates linkages side by side; a linkage whose motion has ended stands still.

    **Arguments:** `motions`: title -> (linkage, its solution); the others as in
    `animate`.

    **Returns:** the animation, as in `animate`.
    """
    geometries = geometries_of(motions)
    shown = list(geometries.values())
    times, pause = _frame_times([ts for ts, _ in shown], fps, speed, max_frames)
    figure, panels = panels_of(geometries, fig)
    return _animation(panels, shown, times, pause, figure.suptitle, fig is None)
