"""An arm in pictures: where its parts are, and their lines and markers."""

from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path

from ..base.checks import refusal, shown
from ..base.known_values import in_numpy
from ..linkage.frames import known_frames
from ..linkage.linkage import Linkage, check_linkage, without_fixed
from ..linkage.topology import letters
from .axes import (
    BLACK,
    GREY,
    SERIES,
    figure_or_new,
    filled_mapping,
    plane_axes,
    reached,
    xy,
)
from .elements import ELEMENT_STYLES, element_lines, element_marker


class Geometry(NamedTuple):
    """A linkage at all samples; points of the plane are complex numbers.

    Link 0 is the ground, links 1 to n move; joint k is between links k - 1 and k.
    """

    angle: np.ndarray  # absolute angles of links 0 to n [rad]: (time, n + 1)
    slide: np.ndarray  # B_1 to B_n [m]: (time, n)
    kinds: str  # R, P or F of each joint
    points: dict[str, np.ndarray]  # by name of the part, in drawing order: (time, ...)

    @property
    def tip(self) -> np.ndarray:
        return self.points[f"tip {len(self.kinds)}"][:, 0]

    @property
    def all_points(self) -> np.ndarray:
        return np.hstack(list(self.points.values()))


def geometry(linkage: Linkage, q: np.ndarray) -> Geometry:
    """The `Geometry` of a linkage at joint positions (time, n)."""
    check_linkage(linkage)
    linkage = in_numpy(linkage)
    kinds = letters(linkage.ef)
    f = known_frames(linkage, without_fixed(linkage, q))
    start, direction, angle, slide = f.start, f.direction, f.angle, f.slide
    end = start + linkage.length * direction
    along, across = linkage.com.T
    foot = start[:, 1:] + along * direction[:, 1:]  # mass centre projected on the link
    center = foot + 1j * across * direction[:, 1:]

    points = {}
    last = len(kinds)
    for k, kind in enumerate(kinds):
        link = [start[:, k], end[:, k]]
        if kind == "P":
            points[f"rail {k + 1}"] = np.column_stack([end[:, k], start[:, k + 1]])
        else:
            link.append(start[:, k + 1])  # across by the fixed B
        points[f"link {k}"] = np.column_stack(link)
    points[f"link {last}"] = np.column_stack([start[:, last], end[:, last]])
    points[f"tip {last}"] = end[:, last:]
    for k in range(last):  # after the tip, where a mass centre may be
        points[f"mass {k + 1}"] = np.column_stack([foot[:, k], center[:, k]])
    for k, kind in enumerate(kinds):
        if kind != "F":
            name = "pin" if kind == "R" else "slider"
            points[f"{name} {k + 1}"] = start[:, k + 1 : k + 2]
    return Geometry(angle, slide, kinds, points)


def with_elements(
    g: Geometry, linkage: Linkage, forces: Any, ts: np.ndarray, q: np.ndarray
) -> Geometry:
    """Adds the force elements that have a place, behind the arm."""
    size = float(max(np.ptp(part) for part in xy(g.all_points)))
    lines = element_lines(linkage, forces, ts, q, size)
    return g._replace(points=lines | g.points)


def link_color(link: int) -> str:
    return SERIES[(link - 1) % len(SERIES)] if link else BLACK


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
    "mass": dict(lw=0.6, marker="o", ms=5, mec="white", mew=0.8, markevery=[1]),
    "pin": dict(color=BLACK, marker="o", markersize=4.5, mfc="white"),
    "slider": dict(markersize=15, mfc="white", mew=0.9),
    "tip": dict(marker="s", markersize=5),
} | ELEMENT_STYLES
_LABELS = {"pin": "pin", "mass": "mass centre", "tip": "tip"}


def _place(lines: dict[str, Line2D], g: Geometry, i: int) -> None:
    """Moves the lines to sample `i`."""
    for name, line in lines.items():
        line.set_data(*xy(g.points[name][i]))
        if name.startswith("slider"):
            across = g.angle[i, int(name[-1]) - 1] + np.pi / 2
            marker = MarkerStyle(_CARRIAGE).rotated(rad=across)
            line.set_marker(marker)  # type: ignore[arg-type]


def draw_arm(
    ax: Axes,
    g: Geometry,
    i: int,
    mass_centers: bool,
    alpha: float = 1.0,
    color: Any = None,
    label: bool = True,
) -> dict[str, Line2D]:
    """Draws sample `i` and returns its lines by name; the name is also the `gid`."""
    lines, labelled = {}, set()  # a kind is labelled once
    for name, points in g.points.items():
        kind, number = name.split()
        if kind == "mass" and not mass_centers:
            continue
        # A joint's rail and carriage belong to the link before it.
        link = int(number) - (kind in ("rail", "slider"))
        (line,) = ax.plot(*xy(points[i]), alpha=alpha, gid=name, color=link_color(link))
        line.set(**_STYLES[kind])
        if color is not None:
            line.set_color(color)
        if name == "link 0":
            line.set_linewidth(1.2)
        elif kind in ELEMENT_STYLES and kind not in labelled:
            marker: Any = element_marker(kind)  # a line in the legend would not tell
            shown = ax.plot([], [], marker=marker, ls="", label=kind, markersize=13)[0]
            shown.set(color=line.get_color(), mfc="none", mew=line.get_linewidth())
        elif label and kind == "slider" and kind not in labelled:
            level = ax.plot([], [], marker=_CARRIAGE, ls="", label="slide")[0]
            level.set(color=line.get_color(), **_STYLES["slider"])
        elif label and kind in _LABELS and kind not in labelled:
            line.set_label(_LABELS[kind])
        elif label and kind == "link":
            line.set_label(name)
        labelled.add(kind)
        lines[name] = line
    _place(lines, g, i)
    return lines


def draw_ground(ax: Axes) -> None:
    ground = ax.plot(0, 0, marker=_BEARING, markersize=18, zorder=1, gid="ground")[0]
    ground.set(mfc="white", mec=GREY, mew=0.8, clip_on=False, ls="", label="ground")


class DrawnMotion(NamedTuple):
    """The lines drawn by `draw_motion`."""

    path: Line2D
    arms: list[dict[str, Line2D]]

    @property
    def lines(self) -> list[Line2D]:
        return [self.path, *(line for arm in self.arms for line in arm.values())]

    def move(self, g: Geometry, indices: np.ndarray) -> None:
        """Moves the lines to a motion of the same topology, at as many samples."""
        self.path.set_data(*xy(g.tip[: indices[-1] + 1]))
        for lines, i in zip(self.arms, indices):
            _place(lines, g, i)


def draw_motion(
    ax: Axes, g: Geometry, indices: np.ndarray, mass_centers: bool
) -> DrawnMotion:
    """Draws the samples `indices` from faint to full, and the tip's path up to them."""
    draw_ground(ax)
    path = xy(g.tip[: indices[-1] + 1])
    (line,) = ax.plot(*path, color=GREY, lw=1, label="tip path", gid="tip path")
    arms = [
        draw_arm(ax, g, i, mass_centers, float(alpha), label=i == indices[-1])
        for i, alpha in zip(indices, np.linspace(1, 0.15, len(indices))[::-1])
    ]
    return DrawnMotion(line, arms)


def geometries_of(motions: Any, forces: Any) -> dict[str, tuple[np.ndarray, Geometry]]:
    """Times and geometry of each motion, with its force elements, by title."""
    filled_mapping("motions", motions, "(Linkage, Solution)")
    forces = (
        {} if forces is None else filled_mapping("forces", forces, "force elements")
    )
    if unknown := forces.keys() - motions.keys():
        raise refusal("forces", f"titles of motions, {list(motions)}", sorted(unknown))
    found = {}
    for title, pair in motions.items():
        name = f"motions[{shown(title)}]"
        fits = isinstance(pair, tuple) and len(pair) == 2
        if not (fits and isinstance(pair[0], Linkage)):
            raise refusal(name, "(Linkage, Solution)", pair)
        ts, q, _ = reached(pair[0], pair[1], name)
        g = geometry(pair[0], q)
        found[title] = ts, with_elements(g, pair[0], forces.get(title, ()), ts, q)
    return found


def panels_of(
    geometries: dict[str, tuple[np.ndarray, Geometry]], fig: Figure | None
) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of axes, one per motion."""
    columns = min(4, len(geometries))
    rows = -(-len(geometries) // columns)
    fig = figure_or_new(fig, 1.3 + 1.75 * columns, 0.4 + 1.9 * rows)
    panels = []
    for position, (title, (_, g)) in enumerate(geometries.items()):
        ax = plane_axes(fig.add_subplot(rows, columns, position + 1), g.tip)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(fill(title, 18), fontsize="medium")  # no wider than its panel
        ax.set(xlabel="", ylabel="")
        ax.tick_params(labelsize="small")
        panels.append(ax)
    fig.supxlabel("x [m]", fontsize="medium")
    fig.supylabel("y [m]", fontsize="medium")
    return fig, panels
