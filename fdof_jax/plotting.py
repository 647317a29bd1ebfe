"""Figures and animations of linkages and their motions, with matplotlib.

Every function draws into the axes (`ax`) or figure (`fig`) it is given, or into a new
one, and returns it. Nothing is shown or saved, and no global setting changes. A
`solution` is that of one `simulate`; what a failed one did not reach is left out.
Links are numbered as in the paper: the ground is link 1, the moving ones are 2 to 4.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from numpy.typing import ArrayLike

from .control import CircleTask, PDController
from .dynamics import link_energies
from .linkage import Linkage, to_chain
from .simulation import Forces, Solution, joint_efforts
from .validation import real_array

# Okabe and Ito's colours, which the common kinds of colour blindness tell apart.
_BLACK, _GREY = "#000000", "#808080"
_SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_LINKS = (_BLACK, *_SERIES[:3])

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


class _Geometry(NamedTuple):
    """Points of a linkage at all samples, (time, link), as complex numbers.

    Link n runs from `start` along A_n to `end`; `direction` is e_n. The next link
    starts at end + B_n ep_n. The last `end` is the tip.
    """

    revolute: np.ndarray
    direction: np.ndarray
    start: np.ndarray
    end: np.ndarray
    foot: np.ndarray  # of each moving link's mass centre on the line of A_n
    center: np.ndarray


def _refuse(name: str, expected: str, got: Any) -> ValueError:
    return ValueError(f"{name}: expected {expected}, got {got!r}.")


def _one(linkage: Any, name: str = "linkage") -> Linkage:
    if not isinstance(linkage, Linkage) or np.shape(linkage.ef) != (6,):
        raise _refuse(name, "one Linkage", linkage)
    return linkage


def _motion(solution: Any, name: str = "solution") -> list[np.ndarray]:
    """`ts`, `q` and `qd` of one solution, without what it did not reach."""
    if not isinstance(solution, Solution) or np.ndim(solution.q) != 2:
        expected = "the Solution of one simulate (of a batch, pass one member)"
        raise _refuse(name, expected, solution)
    arrays = [np.asarray(a) for a in (solution.ts, solution.q, solution.qd)]
    finite = np.isfinite(arrays[1]).all(axis=1)
    if not finite.any():
        raise _refuse(name, "at least one finite sample", solution)
    return [array[finite] for array in arrays]


def _mapping(name: str, value: Any, kind: str) -> Mapping:
    if not isinstance(value, Mapping) or not value:
        raise _refuse(name, f"a dictionary, not empty, of label: {kind}", value)
    return value


def _count(name: str, value: Any, least: int) -> int:
    if not isinstance(value, int | np.integer) or value < least:
        raise _refuse(name, f"an integer of at least {least}", value)
    return int(value)


def _figure(fig: Any, width: float, height: float) -> Figure:
    if fig is None:
        return plt.figure(figsize=(width, height), layout="constrained")
    if not isinstance(fig, Figure):
        raise _refuse("fig", "a matplotlib Figure or None", fig)
    return fig


def _axes(ax: Any, height: float) -> Axes:
    if ax is None:
        return _figure(None, 3.5, height).subplots()
    if not isinstance(ax, Axes):
        raise _refuse("ax", "matplotlib Axes or None", ax)
    return ax


def _xy(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.real(points).ravel(), np.imag(points).ravel()


def _plane_axes(ax: Any, points: np.ndarray) -> Axes:
    """Axes of equal scales; new ones have the proportions of what they will show."""
    width, height = (max(np.ptp(part), 1e-9) for part in _xy(points))
    ax = _axes(ax, 0.9 + np.clip(2.9 * height / width, 1.6, 3.6))
    ax.set_aspect("equal")
    ax.margins(0.1, 0.16)  # below, the ground needs room
    ax.set(xlabel="x [m]", ylabel="y [m]")
    return ax


def _legend(ax: Axes, *others: Axes) -> None:
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


def _chain(linkage: Linkage, q: np.ndarray) -> np.ndarray:
    """Chain coordinates (time, 6) of joint positions (time, 3)."""
    chain = jax.vmap(lambda q: to_chain(linkage, q, jnp.zeros(3))[0])
    return np.asarray(chain(jnp.asarray(q)))


def _geometry(linkage: Linkage, q: np.ndarray) -> _Geometry:
    x = _chain(linkage, q)
    base = np.full(len(x), linkage.base_angle)
    direction = np.exp(1j * np.column_stack([base, x[:, 1::2]]))
    along = np.asarray(linkage.length) * direction
    steps = along[:, :3] + 1j * x[:, 0::2] * direction[:, :3]
    start = np.cumsum(np.column_stack([np.zeros(len(x)), steps]), axis=1)
    com = np.asarray(linkage.com)
    foot = start[:, 1:] + com[:, 0] * direction[:, 1:]
    center = foot + 1j * com[:, 1] * direction[:, 1:]
    revolute = np.asarray(linkage.ef)[1::2] > 0.5
    return _Geometry(revolute, direction, start, start + along, foot, center)


def _shapes(g: _Geometry, i: int) -> dict[str, np.ndarray]:
    """What is drawn of sample `i`: its points by name, in drawing order."""
    shapes = {}
    for n in range(4):
        points = [g.start[i, n], g.end[i, n]]
        if n < 3 and g.revolute[n]:
            points.append(g.start[i, n + 1])  # across by the fixed B_n
        elif n < 3:
            shapes[f"rail {n + 1}"] = np.array([g.end[i, n], g.start[i, n + 1]])
        shapes[f"link {n + 1}"] = np.array(points)
    for n in range(3):
        shapes[f"mass {n + 2}"] = np.array([g.foot[i, n], g.center[i, n]])
    for n in range(3):
        kind = "pin" if g.revolute[n] else "slider"
        shapes[f"{kind} {n + 1}"] = g.start[i, n + 1 : n + 2]
    return shapes | {"tip 4": g.end[i, 3:]}


def _place(lines: dict[str, Line2D], g: _Geometry, i: int) -> None:
    """Move the lines to sample `i`."""
    for name, points in _shapes(g, i).items():
        if name in lines:
            lines[name].set_data(*_xy(points))
            if name.startswith("slider"):
                across = 1j * g.direction[i, int(name[-1]) - 1]
                marker = MarkerStyle(_CARRIAGE).rotated(rad=np.angle(across))
                lines[name].set_marker(marker)  # type: ignore[arg-type]


def _draw(
    ax: Axes,
    g: _Geometry,
    i: int,
    mass_centers: bool,
    alpha: float = 1.0,
    color: Any = None,
    label: bool = True,
) -> dict[str, Line2D]:
    """Lines of sample `i` by name, which is also their `gid`."""
    lines = {}
    for name, points in _shapes(g, i).items():
        kind, number = name.split()
        if kind == "mass" and not mass_centers:
            continue
        own = _BLACK if kind == "pin" else _LINKS[int(number) - 1]
        (lines[name],) = ax.plot(*_xy(points), alpha=alpha, gid=name)
        lines[name].set(color=own if color is None else color, **_STYLES[kind])
        if name == "link 1":
            lines[name].set_linewidth(1.2)
        elif kind == "link" and label:
            lines[name].set_label(name)
    _place(lines, g, i)
    return lines


def _draw_ground(ax: Axes) -> None:
    ground = ax.plot(0, 0, marker=_BEARING, markersize=18, zorder=1, gid="ground")[0]
    ground.set(mfc="white", mec=_GREY, mew=0.8, clip_on=False)


def _draw_motion(
    ax: Axes, g: _Geometry, indices: np.ndarray, mass_centers: bool
) -> None:
    """The path of the tip to the last of the samples, and these from faint to full."""
    _draw_ground(ax)
    path = g.end[: indices[-1] + 1, 3]
    ax.plot(*_xy(path), color=_GREY, lw=1, label="tip path", gid="tip path")
    for i, alpha in zip(indices, np.linspace(1, 0.15, len(indices))[::-1]):
        _draw(ax, g, i, mass_centers, float(alpha), label=i == indices[-1])


def draw_linkage(
    linkage: Linkage,
    q: Float[ArrayLike, " joint"],
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
    geometry = _geometry(_one(linkage), np.asarray(real_array("q", q, (3,)))[None])
    ax = _plane_axes(ax, np.concatenate(list(_shapes(geometry, 0).values())))
    _draw_ground(ax)
    _draw(ax, geometry, 0, mass_centers, alpha, color)
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
    linkage, (ts, q, _) = _one(linkage), _motion(solution)
    step = float(real_array("every", every, (), above=0))
    last = ts[-1]
    if until is not None:
        last = min(last, float(real_array("until", until, (), minimum=float(ts[0]))))
    # The excess keeps the last step where the division falls short by rounding.
    steps = np.arange(np.floor((last - ts[0]) / step + 1e-6) + 1)
    indices = np.unique([np.abs(ts - t).argmin() for t in ts[0] + step * steps])
    geometry = _geometry(linkage, q)
    ax = _plane_axes(ax, geometry.end[: indices[-1] + 1])
    _draw_motion(ax, geometry, indices, mass_centers)
    _legend(ax)
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
    _mapping("motions", motions, "(Linkage, Solution)")
    configurations = _count("configurations", configurations, 2)
    geometries = {}
    for title, pair in motions.items():
        name = f"motions[{title!r}]"
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise _refuse(name, "(Linkage, Solution)", pair)
        geometries[title] = _geometry(_one(pair[0], name), _motion(pair[1], name)[1])
    columns = min(4, len(motions))
    rows = -(-len(motions) // columns)
    fig = _figure(fig, 0.3 + 1.75 * columns, 0.4 + 1.9 * rows)
    for position, (title, geometry) in enumerate(geometries.items()):
        last = len(geometry.end) - 1
        indices = np.linspace(0, last, configurations).round().astype(int)
        ax = _plane_axes(fig.add_subplot(rows, columns, position + 1), geometry.end)
        _draw_motion(ax, geometry, np.unique(indices), mass_centers=False)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(title=title, xlabel="", ylabel="")
        ax.tick_params(labelsize="small")
    fig.supxlabel("x [m]", fontsize="medium")
    fig.supylabel("y [m]", fontsize="medium")
    return fig


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
    ts, q, _ = _motion(solution)
    x = _chain(_one(linkage), q)
    angles, slides = [], []
    for k, revolute in enumerate(np.asarray(linkage.ef)[1::2] > 0.5):
        if revolute:
            degrees = np.rad2deg(x[:, 2 * k + 1])
            angles.append((rf"$\theta_{k + 2}$", degrees, _SERIES[k]))
        else:
            slides.append((f"$B_{k + 1}$", x[:, 2 * k], _SERIES[k]))
    panels = [("angle [degrees]", angles), ("slide [m]", slides)][: 1 + bool(slides)]
    fig = _figure(fig, 3.5, 0.6 + 1.9 * len(panels))
    for ax in _time_panels(fig, ts, panels):
        _legend(ax)
    return fig


def energy_profile(
    linkage: Linkage, solution: Solution, fig: Figure | None = None
) -> Figure:
    """Kinetic and potential energy of each link, and of all together, over time [J].

    **Returns:** the figure.

    **Raises:** ValueError for malformed arguments.
    """
    linkage, (ts, q, qd) = _one(linkage), _motion(solution)
    energies = jax.vmap(lambda q, qd: link_energies(linkage, q, qd))(q, qd)
    kinetic, potential = (np.asarray(each) for each in energies)
    names = "link 2", "link 3", "link 4"
    sums = kinetic.sum(axis=1), potential.sum(axis=1), (kinetic + potential).sum(axis=1)
    whole = zip(("kinetic", "potential", "total"), sums, (*_SERIES[3:5], _BLACK))
    panels = [
        ("kinetic energy [J]", list(zip(names, kinetic.T, _SERIES))),
        ("potential energy [J]", list(zip(names, potential.T, _SERIES))),
        ("of all links [J]", list(whole)),
    ]
    fig = _figure(fig, 3.5, 6.0)
    top, _, bottom = _time_panels(fig, ts, panels)
    _legend(top)
    _legend(bottom)
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
    _motion(solution)
    efforts = joint_efforts(_one(linkage), forces, solution)
    ts, total, elements = (np.asarray(a) for a in (solution.ts, *efforts))
    units = np.where(np.asarray(linkage.ef)[1::2] > 0.5, "N m", "N")
    panels = []
    for k, unit in enumerate(units):
        symbol = f"$T_{k + 2}$" if unit == "N m" else f"$F_{k + 1}$"
        panels.append((f"{symbol} [{unit}]", [("total", total[:, k], _SERIES[0])]))
    fig = _figure(fig, 3.5, 5.2)
    axes = _time_panels(fig, ts, panels)
    for k, (ax, unit) in enumerate(zip(axes, units)):
        low, high = ax.get_ylim()  # not those of the bands, which may be far wider
        for element, effort in zip(forces, elements):
            if isinstance(element, PDController) and np.isfinite(element.limit[k]):
                limit = float(element.limit[k])
                ax.axhspan(-limit, limit, color=_GREY, alpha=0.15, lw=0, label="limits")
                at = np.abs(effort[:, k]) >= limit
                dots = ax.plot(ts[at], effort[at, k], ".", color=_SERIES[1], zorder=3)
                dots[0].set(label="saturated", gid=f"saturated {k + 1}")
                if at.any():
                    low, high = min(low, -1.1 * limit), max(high, 1.1 * limit)
                text = ax.text(0.98, 0.08, f"limit ±{limit:g} {unit}", ha="right")
                text.set(fontsize="small", transform=ax.transAxes)
        ax.set_ylim(low, high)
    _legend(axes[0], *axes)
    return fig


def _tips(linkage: Any, task: Any, solutions: Any) -> list[tuple]:
    """Per solution its label, colour, times, and commanded and actual tip positions."""
    if not callable(getattr(task, "tip", None)):
        raise _refuse("task", "a CircleTask", task)
    curves = []
    for label, solution in _mapping("solutions", solutions, "Solution").items():
        ts, q, _ = _motion(solution, f"solutions[{label!r}]")
        commanded = np.asarray(jax.vmap(task.tip)(jnp.asarray(ts))) @ [1, 1j]
        actual = _geometry(_one(linkage), q).end[:, 3]
        color = _SERIES[len(curves) % len(_SERIES)]
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
    paths.append(("commanded", _BLACK, "--", longest))
    ax = _plane_axes(ax, np.concatenate([path for *_, path in paths]))
    for label, color, style, path in paths:
        ax.plot(*_xy(path), style, color=color, lw=1.2, label=label)
        ax.plot(*_xy(path[:1]), "o", color=color, markersize=4)
    _legend(ax)
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
    ax = _axes(ax, 2.6)
    for label, color, ts, commanded, actual in curves:
        ax.plot(ts, np.abs(actual - commanded), color=color, lw=1.2, label=label)
    ax.set(xlabel="time [s]", ylabel="tip error [m]")
    ax.set_ylim(bottom=0)
    _legend(ax)
    return ax


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
    linkage, (ts, q, _) = _one(linkage), _motion(solution)
    fps = float(real_array("fps", fps, (), above=0))
    duration = (ts[-1] - ts[0]) / float(real_array("speed", speed, (), above=0))
    frames = min(_count("max_frames", max_frames, 1), int(np.ceil(duration * fps)) + 1)
    samples = [np.abs(ts - t).argmin() for t in np.linspace(ts[0], ts[-1], frames)]

    geometry = _geometry(linkage, q)
    path = geometry.end[:, 3]
    points = np.column_stack([geometry.start, geometry.end, geometry.center])
    given, ax = ax, _plane_axes(ax, points)
    _draw_ground(ax)
    (trace,) = ax.plot(*_xy(points), color=_GREY, lw=1, gid="tip path")
    lines = _draw(ax, geometry, 0, mass_centers=True)
    ax.autoscale_view()
    ax.autoscale(False)  # at limits that hold all samples

    def show(frame: int) -> list[Line2D]:
        i = samples[frame]
        _place(lines, geometry, i)
        trace.set_data(*_xy(path[: i + 1]))
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
