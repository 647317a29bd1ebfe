"""Pictures and animations of linkages in the plane, with matplotlib.

Every function draws into the given axes (`ax`) or figure (`fig`), or into a new one,
and returns it: pictures of one panel take and return axes, those of several a figure;
`animate` and `animate_grid` return an animation. Nothing is shown or
saved, and no global setting changes. A `solution` is that of one `simulate`, or a
`SampledMotion`, whose forces are `(control, *forces)`; of a failed one, the samples
reached are drawn. Link 0 is the ground, links 1, 2, ... move.
Malformed arguments raise ValueError. Curves over time are in `plotting`.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from ..base.checks import real_array, whole_number
from ..forces.element import Forces
from ..linkage.linkage import Linkage, check_linkage, per_joint
from ..simulation.sampled import Motion
from .animation import animation_of, frame_times
from .arms import (
    draw_arm,
    draw_ground,
    draw_motion,
    geometries_of,
    geometry,
    panels_of,
    with_elements,
)
from .axes import BLACK, GREY, SERIES, figure_legend, legend, plane_axes, reached
from .workspace import force_ellipses, inertia_ellipses, workspace

__all__ = [
    "BLACK", "GREY", "SERIES", "animate", "animate_grid", "chrono_cyclograph",
    "draw_linkage", "force_ellipses", "inertia_ellipses", "topology_grid", "workspace",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


def draw_linkage(
    linkage: Linkage,
    q: ArrayLike,
    ax: Axes | None = None,
    *,
    forces: Forces = (),
    color: Any = None,
    alpha: float = 1.0,
    mass_centers: bool = True,
) -> Axes:
    """Draws one configuration, to scale.

    A link is a line along its vector A, bent by the fixed B where the next joint is
    revolute. Real revolute joints are pins; real prismatic joints are carriages on a
    rail of length B. Fictitious joints are not drawn. The tip is a square. A mass
    centre is a dot, joined to its link if it lies beside it.

    Of the force elements, those with a place are drawn: springs, dampers, cables (which
    hang if slack), bumpers, cylinders, wrenches as arrows, stops as bars at the ends
    of a joint's range, and of a controller the path on which it leads the tip, dashed.
    The longest arrow is that of the greatest force. Thin lines join points beside their
    link to it, and hatched ground holds points of the ground.

    **Arguments:** `q`: joint positions [m or rad]; `forces`: elements, drawn as they
    are at time 0; `color`: common colour of all links, by default one per link;
    `alpha`: opacity, 0 to 1; `mass_centers`: whether to draw them.

    **Returns:** the axes. The `gid` of a line names its part: "link 1", "pin 1",
    "rail 2", "slider 2", "mass 3", "tip 3", "ground"; of an element, its kind and its
    index: "spring 0", "cylinder 1". New axes have a legend of the parts above them.
    """
    check_linkage(linkage)
    q = np.asarray(per_joint("q", q, linkage))[None]
    g = with_elements(geometry(linkage, q), linkage, forces, np.zeros(1), q)
    panel = plane_axes(ax, g.all_points)
    draw_ground(panel)
    draw_arm(panel, g, 0, mass_centers, alpha, color)
    if ax is None:
        legend(panel)
    return panel


def chrono_cyclograph(
    linkage: Linkage,
    solution: Motion,
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
    last = _last(ts, until)
    # The added 1e-6 keeps the last step if the division falls short by rounding.
    steps = np.arange(np.floor((last - ts[0]) / step + 1e-6) + 1)
    indices = np.unique([np.abs(ts - t).argmin() for t in ts[0] + step * steps])
    ax = plane_axes(ax, g.all_points[: indices[-1] + 1])
    draw_motion(ax, g, indices, mass_centers)
    legend(ax)
    return ax


def _last(ts: np.ndarray, until: float | None) -> float:
    """The last time to draw."""
    if until is None:
        return ts[-1]
    return min(ts[-1], float(real_array("until", until, (), minimum=float(ts[0]))))


def topology_grid(
    motions: Mapping[str, tuple[Linkage, Motion]],
    fig: Figure | None = None,
    *,
    forces: Mapping[str, Forces] | None = None,
    configurations: int = 3,
) -> Figure:
    """Draws linkages side by side, each with a few configurations and its tip's path.

    **Arguments:** `motions`: title -> (linkage, its solution); `forces`: title ->
    elements to draw, as in `draw_linkage`; `configurations`: number for each, evenly
    spaced in samples from the first (faint) to the last.
    """
    whole_number("configurations", configurations, 2)
    geometries = geometries_of(motions, forces)
    fig, panels = panels_of(geometries, fig)
    for ax, (ts, g) in zip(panels, geometries.values()):
        indices = np.linspace(0, len(ts) - 1, configurations).round().astype(int)
        draw_motion(ax, g, np.unique(indices), mass_centers=False)
    figure_legend(fig)
    return fig


def animate(
    linkage: Linkage,
    solution: Motion,
    ax: Axes | None = None,
    *,
    forces: Forces = (),
    until: float | None = None,
    fps: float = 25,
    speed: float = 1.0,
    max_frames: int = 250,
) -> FuncAnimation:
    """Animates a motion, with the path of the tip so far.

    Each frame shows the nearest sample. If a motion needs more than `max_frames`, it is
    shown with fewer frames per second.

    **Arguments:** `forces`: elements to draw, as in `draw_linkage`; `until`: last time,
    by default the solution's [s]; `fps`: frames per second; `speed`: 2 shows the motion
    twice as fast.

    **Returns:** the animation; a notebook plays it if it is the last line of a cell.
    In a new figure a legend names every mark. Keep the animation until it is shown.
    `.save("motion.gif")` and `.save("motion.mp4")` write it with a progress bar, the
    latter with ffmpeg; `.to_jshtml()` returns a player as text, for a web page.
    """
    ts, q, _ = reached(linkage, solution)
    shown = ts <= _last(ts, until)
    ts, q = ts[shown], q[shown]
    times, pause = frame_times([ts], fps, speed, max_frames)
    g = with_elements(geometry(linkage, q), linkage, forces, ts, q)
    panel, new = plane_axes(ax, g.all_points), ax is None
    figure = panel.get_figure(root=True)
    if new and figure is not None:
        figure.set_figwidth(4.8)  # the legend stands beside
    return animation_of([panel], [(ts, g)], times, pause, panel.set_title, new)


def animate_grid(
    motions: Mapping[str, tuple[Linkage, Motion]],
    fig: Figure | None = None,
    *,
    forces: Mapping[str, Forces] | None = None,
    fps: float = 25,
    speed: float = 1.0,
    max_frames: int = 250,
) -> FuncAnimation:
    """Animates linkages side by side; a linkage whose motion has ended stands still.

    **Arguments:** `motions`: title -> (linkage, its solution); `forces`: title ->
    elements to draw, as in `draw_linkage`; the others as in `animate`.

    **Returns:** the animation, as in `animate`.
    """
    geometries = geometries_of(motions, forces)
    shown = list(geometries.values())
    times, pause = frame_times([ts for ts, _ in shown], fps, speed, max_frames)
    figure, panels = panels_of(geometries, fig)
    say = partial(figure.suptitle, x=0.02, ha="left")  # the legend is on the right
    return animation_of(panels, shown, times, pause, say, fig is None)
