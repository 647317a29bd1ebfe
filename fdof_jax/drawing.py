"""Pictures and animations of linkages in the plane, with matplotlib.

Every function draws into the axes (`ax`) or figure (`fig`) it is given, or into a new
one, and returns it; `animate` returns its animation. Nothing is shown or saved, and no
global setting changes. A `solution` is that of one `simulate`; what a failed one did
not reach is left out. Links are numbered as in the paper: the ground is link 1, the
moving ones are 2 to 4. Curves over time are in `plotting`.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from numpy.typing import ArrayLike

from .linkage import Linkage, to_chain
from .solution import Solution
from .validation import real_array

# Okabe and Ito's colours, which the common kinds of colour blindness tell apart.
BLACK, GREY = "#000000", "#808080"
SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
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


class Geometry(NamedTuple):
    """A linkage at all samples; points of the plane are complex numbers.

    Link n runs from where joint n - 1 puts it along A_n to its `end`; the end of link 4
    is the tip.
    """

    angle: np.ndarray  # th_1 to th_4 [rad]: (time, 4)
    slide: np.ndarray  # B_1 to B_3 [m]: (time, 3)
    revolute: np.ndarray  # whether each real joint is: (3,)
    end: np.ndarray  # (time, 4)
    points: dict[str, np.ndarray]  # of all to draw, by name in that order: (time, n)


def refuse(name: str, expected: str, got: Any) -> ValueError:
    """The error to raise for a malformed argument."""
    return ValueError(f"{name}: expected {expected}, got {got!r}.")


def reached(solution: Any, name: str = "solution") -> list[np.ndarray]:
    """`ts`, `q` and `qd` of one solution, without what it did not reach."""
    if not isinstance(solution, Solution) or np.ndim(solution.q) != 2:
        expected = "the Solution of one simulate (of a batch, pass one member)"
        raise refuse(name, expected, solution)
    arrays = [np.asarray(a) for a in (solution.ts, solution.q, solution.qd)]
    finite = np.isfinite(arrays[1]).all(axis=1)
    if not finite.any():
        raise refuse(name, "at least one finite sample", solution)
    return [array[finite] for array in arrays]


def filled_mapping(name: str, value: Any, kind: str) -> Mapping:
    """`value` if it is a dictionary with something in it, else ValueError."""
    if not isinstance(value, Mapping) or not value:
        raise refuse(name, f"a dictionary, not empty, of label: {kind}", value)
    return value


def _count(name: str, value: Any, least: int) -> int:
    if not isinstance(value, int | np.integer) or value < least:
        raise refuse(name, f"an integer of at least {least}", value)
    return int(value)


def figure_or_new(fig: Any, width: float, height: float) -> Figure:
    """`fig`, or a new figure of that size [inches]."""
    if fig is None:
        return plt.figure(figsize=(width, height), layout="constrained")
    if not isinstance(fig, Figure):
        raise refuse("fig", "a matplotlib Figure or None", fig)
    return fig


def axes_or_new(ax: Any, height: float) -> Axes:
    """`ax`, or those of a new figure of that height [inches]."""
    if ax is None:
        return figure_or_new(None, 3.5, height).subplots()
    if not isinstance(ax, Axes):
        raise refuse("ax", "matplotlib Axes or None", ax)
    return ax


def xy(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of complex points."""
    return np.real(points).ravel(), np.imag(points).ravel()


def plane_axes(ax: Any, points: np.ndarray) -> Axes:
    """Axes of equal scales; new ones have the proportions of what they will show."""
    width, height = (max(np.ptp(part), 1e-9) for part in xy(points))
    ax = axes_or_new(ax, 0.9 + np.clip(2.9 * height / width, 1.6, 3.6))
    ax.set_aspect("equal")
    ax.margins(0.1, 0.16)  # below, the ground needs room
    ax.set(xlabel="x [m]", ylabel="y [m]")
    return ax


def legend(ax: Axes, *others: Axes) -> None:
    """A legend above the axes, where it hides nothing, of all that has a label."""
    found = {}
    for handles, labels in (a.get_legend_handles_labels() for a in (ax, *others)):
        found |= dict(zip(labels, handles))
    columns = max(1, 48 // (4 + max(map(len, found))))
    ax.legend(
        list(found.values()), list(found), ncols=columns, fontsize="small",
        frameon=False, handlelength=1.2, columnspacing=1,
        loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2,
    )  # fmt: skip


def geometry(linkage: Linkage, q: np.ndarray) -> Geometry:
    """Where a linkage is at joint positions (time, 3)."""
    x = np.asarray(jax.vmap(lambda q: to_chain(linkage, q, np.zeros(3))[0])(q))
    angle = np.column_stack([np.full(len(x), linkage.base_angle), x[:, 1::2]])
    slide = x[:, 0::2]
    direction = np.exp(1j * angle)
    along = np.asarray(linkage.length) * direction
    steps = along[:, :3] + 1j * slide * direction[:, :3]
    start = np.cumsum(np.column_stack([np.zeros(len(x)), steps]), axis=1)
    end = start + along
    com = np.asarray(linkage.com)
    foot = start[:, 1:] + com[:, 0] * direction[:, 1:]  # of the mass centre on A_n
    center = foot + 1j * com[:, 1] * direction[:, 1:]
    revolute = np.asarray(linkage.ef)[1::2] > 0.5

    points = {}
    for n in range(4):
        link = [start[:, n], end[:, n]]
        if n < 3 and revolute[n]:
            link.append(start[:, n + 1])  # across by the fixed B_n
        elif n < 3:
            points[f"rail {n + 1}"] = np.column_stack([end[:, n], start[:, n + 1]])
        points[f"link {n + 1}"] = np.column_stack(link)
    for n in range(3):
        points[f"mass {n + 2}"] = np.column_stack([foot[:, n], center[:, n]])
    for n in range(3):
        kind = "pin" if revolute[n] else "slider"
        points[f"{kind} {n + 1}"] = start[:, n + 1 : n + 2]
    points["tip 4"] = end[:, 3:]
    return Geometry(angle, slide, revolute, end, points)


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


def draw_motion(ax: Axes, g: Geometry, indices: np.ndarray, mass_centers: bool) -> None:
    """The path of the tip to the last of the samples, and these from faint to full."""
    _draw_ground(ax)
    path = g.end[: indices[-1] + 1, 3]
    ax.plot(*xy(path), color=GREY, lw=1, label="tip path", gid="tip path")
    for i, alpha in zip(indices, np.linspace(1, 0.15, len(indices))[::-1]):
        _draw(ax, g, i, mass_centers, float(alpha), label=i == indices[-1])


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
    filled_mapping("motions", motions, "(Linkage, Solution)")
    configurations = _count("configurations", configurations, 2)
    geometries = {}
    for title, pair in motions.items():
        name = f"motions[{title!r}]"
        fits = isinstance(pair, tuple) and len(pair) == 2
        if not (fits and isinstance(pair[0], Linkage)):
            raise refuse(name, "(Linkage, Solution)", pair)
        _, q, _ = reached(pair[1], name)
        geometries[title] = geometry(pair[0], q)
    columns = min(4, len(motions))
    rows = -(-len(motions) // columns)
    fig = figure_or_new(fig, 0.3 + 1.75 * columns, 0.4 + 1.9 * rows)
    for position, (title, g) in enumerate(geometries.items()):
        last = len(g.end) - 1
        indices = np.linspace(0, last, configurations).round().astype(int)
        ax = plane_axes(fig.add_subplot(rows, columns, position + 1), g.end)
        draw_motion(ax, g, np.unique(indices), mass_centers=False)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(title=title, xlabel="", ylabel="")
        ax.tick_params(labelsize="small")
    fig.supxlabel("x [m]", fontsize="medium")
    fig.supylabel("y [m]", fontsize="medium")
    return fig


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

    **Returns:** the animation. Keep it until it is shown; `.save("motion.gif")` writes
    it and `.to_jshtml()` is a player for notebooks.

    **Raises:** ValueError for malformed arguments.
    """
    ts, q, _ = reached(solution)
    g = geometry(linkage, q)
    fps = float(real_array("fps", fps, (), above=0))
    duration = (ts[-1] - ts[0]) / float(real_array("speed", speed, (), above=0))
    frames = min(_count("max_frames", max_frames, 1), int(np.ceil(duration * fps)) + 1)
    samples = [np.abs(ts - t).argmin() for t in np.linspace(ts[0], ts[-1], frames)]

    points = np.hstack(list(g.points.values()))
    given, ax = ax, plane_axes(ax, points)
    _draw_ground(ax)
    (trace,) = ax.plot(*xy(points), color=GREY, lw=1, gid="tip path")
    lines = _draw(ax, g, 0, mass_centers=True)
    ax.autoscale_view()
    ax.autoscale(False)  # at limits that hold all samples

    def show(frame: int) -> list[Line2D]:
        i = samples[frame]
        _place(lines, g, i)
        trace.set_data(*xy(g.end[: i + 1, 3]))
        ax.set_title(f"t = {ts[i]:.2f} s", fontsize="medium")
        return [*lines.values(), trace]

    show(0)
    figure = ax.get_figure(root=True)
    assert figure is not None  # axes are always in a figure
    if given is None:
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # a layout per frame takes half the time
    pause = 1000 * duration / (frames - 1) if frames > 1 else 1000 / fps  # ms
    return FuncAnimation(figure, show, frames, interval=pause, cache_frame_data=False)
