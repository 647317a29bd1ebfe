"""An arm in pictures: where its parts are, and their lines and markers."""

from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path
from matplotlib.typing import ColorType
from numpy.typing import ArrayLike

from .. import Linkage
from ..checks import real_array
from ..linkage import link_frames
from .axes import ACCENT, BLACK, GREY, SERIES, Keywords, xy
from .elements import ELEMENT_STYLES, element_lines, element_marker


class Geometry(NamedTuple):
    """The points of a linkage's parts, as `geometry` returns them."""

    angle: np.ndarray
    kinds: str
    points: dict[str, np.ndarray]

    @property
    def tip(self) -> np.ndarray:
        return self.points[f"tip {len(self.kinds)}"][:, 0]

    @property
    def all_points(self) -> np.ndarray:
        return np.hstack(list(self.points.values()))

    @property
    def extent(self) -> float:
        return float(max(np.ptp(part) for part in xy(self.all_points)))


def geometry(
    linkage: Linkage, q: ArrayLike, ts: ArrayLike | None = None, forces: tuple = ()
) -> Geometry:
    """Computes the points of a linkage's parts along a motion, for other renderers.

    **Arguments:** `q`: joint positions (time, n) [m or rad]; `ts`: their times [s],
    without which `forces` are left out.

    **Returns:** a tuple with these names:

    - `angle`: absolute angles of links 0 (the ground) to n, (time, n + 1) [rad].
    - `kinds`: R, P or F of each joint.
    - `points`: corners x + iy of each part's line, (time, corner) [m], by the names of
      `draw_linkage`, in the order of drawing; NaN lifts the pen.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.drawing.geometry(arm, [[0, 0, 0]]).points["tip 3"].tolist()  # [m]
    [[(3+0j)]]
    """
    f = link_frames(linkage, q)
    if ts is not None:
        ts = np.asarray(real_array("ts", ts, (len(f.angle),)))
    arm = jax.device_get(linkage)
    kinds = arm.topology
    start, direction = f.start, f.direction
    end = start + arm.length * direction
    # Mass centres, projected on their links and in their places.
    foot = start[:, 1:] + arm.com[:, 0] * direction[:, 1:]
    center = foot + 1j * arm.com[:, 1] * direction[:, 1:]

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
    for k in range(last):  # before the tip and pins, where a mass centre may be
        points[f"mass {k + 1}"] = np.column_stack([foot[:, k], center[:, k]])
    points[f"tip {last}"] = end[:, last:]
    for k, kind in enumerate(kinds):
        if kind != "F":
            name = "pin" if kind == "R" else "slider"
            points[f"{name} {k + 1}"] = start[:, k + 1 : k + 2]
    g = Geometry(f.angle, kinds, points)
    if ts is None:
        return g
    return g._replace(points=element_lines(linkage, forces, f, ts, g.extent) | points)


# Cool colours first, among which the tip's path stands out.
_LINKS = [SERIES[k] for k in (0, 5, 2, 3, 4)]


def link_color(link: int) -> str:
    return _LINKS[(link - 1) % len(_LINKS)] if link else BLACK


# Markers, in points: a carriage on a piece of its rail, a bearing on hatched ground.
# Path codes: 1 moves the pen, 2 draws a line, 79 closes the outline.
_BOX = [(-0.55, -0.35), (0.55, -0.35), (0.55, 0.35), (-0.55, 0.35), (0, 0)]
_CARRIAGE = Path([(-1, 0), (1, 0), *_BOX], [1, 2, 1, 2, 2, 2, 79])
_HATCH = [p for x in (-0.9, -0.45, 0, 0.45) for p in ((x, -1), (x + 0.3, -0.7))]
_BEARING = Path(
    [(0, 0), (-0.5, -0.7), (0.5, -0.7), (0, 0), (-0.9, -0.7), (0.9, -0.7), *_HATCH],
    [1, 2, 2, 79] + [1, 2] * 5,
)

_STYLES: dict[str, Keywords] = {
    "link": dict(lw=3, solid_capstyle="round", solid_joinstyle="round"),
    "rail": dict(lw=0.9),
    "mass": dict(lw=1, marker="o", ms=8, markevery=[1]),
    "pin": dict(color=BLACK, marker="o", mfc="white"),
    "slider": dict(markersize=15, mfc="white", mew=0.9),
    "tip": dict(color=ACCENT, marker="o", ms=5),
} | ELEMENT_STYLES
_LABELS = {"mass": "mass centre", "slider": "slide", "rail": None, "pin": None}
# In a legend, where a carriage is level, and a line would not show an element.
_SYMBOLS: dict[str, Keywords] = {
    "slider": dict(marker=_CARRIAGE) | _STYLES["slider"],
    "mass": dict(marker="o", ms=8, color=GREY),
} | {
    kind: dict(marker=element_marker(kind), markersize=13, mfc="none", mew=style["lw"])
    for kind, style in ELEMENT_STYLES.items()
}


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
    color: ColorType | None = None,
    bare: bool = False,
) -> dict[str, Line2D]:
    """Draws sample `i` and returns its lines by name, which is also the `gid`.

    A `bare` arm has only links and rails, without labels; `alpha` then mixes colours
    with white.
    """
    lines, labels = {}, set()
    for name, points in g.points.items():
        kind, number = name.split()
        if kind == "mass" and not mass_centers:
            continue
        if bare and kind not in ("link", "rail"):
            continue
        # A joint's rail and carriage belong to the link before it.
        link = int(number) - (kind in ("rail", "slider"))
        (line,) = ax.plot(*xy(points[i]), gid=name, color=link_color(link))
        line.set(**_STYLES[kind])
        if bare:
            faded = 1 - alpha * (1 - np.array(to_rgb(link_color(link))))
            line.set(color=faded, lw=min(2, line.get_linewidth()))
        else:
            line.set(color=color or line.get_color(), alpha=alpha)
        lines[name] = line
        text = name if kind == "link" else _LABELS.get(kind, kind)
        if name == "link 0":
            line.set_linewidth(1.2)
        elif not bare and text and text not in labels:
            labels.add(text)
            if kind in _SYMBOLS:
                (line,) = ax.plot([], [], ls="", color=line.get_color())
                line.set(**_SYMBOLS[kind])
            line.set_label(text)
    _place(lines, g, i)
    return lines


def draw_ground(ax: Axes) -> None:
    ground = ax.plot(0, 0, marker=_BEARING, markersize=18, gid="ground")[0]
    ground.set(mfc="white", mec=GREY, mew=0.8, clip_on=False, ls="")


class DrawnMotion(NamedTuple):
    """The lines drawn by `draw_motion`."""

    path: Line2D
    arms: list[dict[str, Line2D]]

    @property
    def lines(self) -> list[Line2D]:
        return [self.path, *(line for arm in self.arms for line in arm.values())]

    def move(self, g: Geometry, indices: np.ndarray) -> None:
        """Moves the lines to as many samples of a motion of the same topology."""
        self.path.set_data(*xy(g.tip[: indices[-1] + 1]))
        for lines, i in zip(self.arms, indices):
            _place(lines, g, i)


def draw_motion(
    ax: Axes, g: Geometry, indices: np.ndarray, mass_centers: bool
) -> DrawnMotion:
    """Draws samples from faint to full, and the tip's path up to the last."""
    faint = np.linspace(0.2, 0.7, len(indices) - 1)
    arms = [
        draw_arm(ax, g, i, mass_centers, alpha, bare=True)
        for i, alpha in zip(indices, faint)
    ]
    draw_ground(ax)
    arms.append(draw_arm(ax, g, indices[-1], mass_centers))
    path = xy(g.tip[: indices[-1] + 1])
    (line,) = ax.plot(*path, color=ACCENT, label="tip", gid="tip path", zorder=3)
    line.set(marker="o", ms=4, markevery=[*indices])
    return DrawnMotion(line, arms)
