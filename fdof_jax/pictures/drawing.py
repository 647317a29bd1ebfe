"""Pictures and animations of linkages in the plane, with matplotlib."""

import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox
from matplotlib.typing import ColorType
from numpy.typing import ArrayLike
from PIL import Image

from .. import Linkage, Solution
from ..checks import (
    check_linkage,
    instance,
    per_joint,
    real_array,
    refusal,
    shown,
    whole_number,
)
from .arms import Geometry, draw_arm, draw_ground, draw_motion, geometry
from .axes import (
    BLACK,
    GREY,
    SERIES,
    Keywords,
    ending,
    figure_legend,
    figure_of,
    figure_or_new,
    filled_mapping,
    legend,
    plane_axes,
    reached,
    xy,
)

__all__ = [
    "BLACK", "GREY", "SERIES", "animate", "animate_grid", "chrono_cyclograph",
    "draw_linkage", "geometry", "topology_grid",
]  # fmt: skip


_LEADER: Keywords = dict(arrowstyle="-", lw=0.8, shrinkA=0, shrinkB=5)
# About so many configurations have their time, at the first of these angles [rad] from
# their last link at which nothing lies below.
_TIMES, _TURNS = 5, np.pi / 6 * np.array([0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6])
__dir__ = __all__.copy


def draw_linkage(
    linkage: Linkage,
    q: ArrayLike,
    ax: Axes | None = None,
    *,
    forces: tuple = (),
    color: ColorType | None = None,
    alpha: float = 1.0,
    mass_centers: bool = True,
) -> Axes:
    """Draws one configuration, to scale.

    A link is a line along its vector A, bent by the fixed B where the next joint is
    revolute. Revolute joints are pins; prismatic joints are carriages on a rail of
    length B. Fictitious joints are not drawn. The tip is an orange dot, a mass centre a
    dot in its link's colour.

    Force elements that have a place are drawn too: springs, dampers, cables, bumpers,
    cylinders, payloads, stops, wrenches as arrows (the longest for the greatest force),
    and the commanded path of the tip, dashed.

    **Arguments:** `q`: joint positions [m or rad]; `forces`: drawn as they are at time
    0; `color`: of all links, by default one each; `alpha`: opacity, 0 to 1.

    **Returns:** the axes; new ones have a legend. The `gid` of a line names its part:
    "link 1", "pin 1", "rail 2", "slider 2", "mass 3", "tip 3", "ground"; of an element,
    its kind and its index: "spring 0".
    """
    check_linkage(linkage)
    instance("mass_centers", mass_centers, bool)
    q = np.asarray(per_joint("q", q, linkage))[None]
    g = geometry(linkage, q, np.zeros(1), forces)
    panel = plane_axes(ax, g.all_points)
    draw_ground(panel)
    draw_arm(panel, g, 0, mass_centers, alpha, color)
    if ax is None:
        legend(panel)
    return panel


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

    The paper's Figs 3, 5 and 7 are such pictures. Only the last configuration has all
    its parts. A dot on the path marks each step; a few carry their time.

    **Arguments:** `every`: time step [s], at which the nearest samples are drawn;
    `until`: last time, by default the solution's [s].

    **Raises:** ValueError for malformed arguments and for an `until` before the start.
    """
    ts, q, _ = reached(linkage, solution)
    instance("mass_centers", mass_centers, bool)
    g = geometry(linkage, q)
    step = float(real_array("every", every, (), above=0))
    last = _last(ts, until)
    # The added 1e-6 keeps the last step if the division falls short by rounding.
    steps = np.arange(np.floor((last - ts[0]) / step + 1e-6) + 1)
    indices = np.unique([np.abs(ts - t).argmin() for t in ts[0] + step * steps])
    end = indices[-1]  # which alone has mass centres
    shown = [
        part[end if name.startswith("mass") else 0 : end + 1]
        for name, part in g.points.items()
    ]
    ax = plane_axes(ax, np.concatenate(shown, axis=None))
    ax.margins(0.13, 0.16)  # for the times
    draw_motion(ax, g, indices, mass_centers)
    if text := ending(solution):
        ax.plot([], [], " ", label=text)
    legend(ax)
    _write_times(ax, ts, g, indices)
    return ax


def _write_times(ax: Axes, ts: np.ndarray, g: Geometry, indices: np.ndarray) -> None:
    """Writes times beside tips, from the last one, where they hide nothing."""
    point = figure_of(ax).dpi / 72
    drawn = [line.get_path().transformed(ax.transData) for line in ax.lines]
    boxes: list[Bbox] = []
    for i in indices[:: -max(1, len(indices) // _TIMES)]:
        tip = np.ravel(xy(g.tip[i]))
        at = ax.transData.transform(tip)
        for far, turn in product((1, 1.8) if i == indices[-1] else (1,), _TURNS):
            way = np.exp(1j * (g.angle[i, -1] + turn))  # ahead of the last link first
            away = 24 * far * way.real, 15 * far * way.imag  # from the tip [points]
            box = Bbox(at + point * (np.array(away) + [[-18, -8], [18, 8]]))
            inside = ax.bbox.contains(*box.min) and ax.bbox.contains(*box.max)
            hit = any(path.intersects_bbox(box, filled=False) for path in drawn)
            if inside and not hit and not box.count_overlaps(boxes):
                boxes.append(box)
                ax.annotate(
                    f"{ts[i]:.3g} s", tuple(tip), away, ha="center",
                    va="center", textcoords="offset points", gid="time", zorder=5,
                    arrowprops=_LEADER if far > 1 else None,
                    path_effects=[withStroke(linewidth=3, foreground="white")],
                )  # fmt: skip
                break


def _last(ts: np.ndarray, until: float | None) -> float:
    if until is None:
        return ts[-1]
    return min(ts[-1], float(real_array("until", until, (), minimum=float(ts[0]))))


def topology_grid(
    motions: Mapping[str, tuple[Linkage, Solution]],
    fig: Figure | None = None,
    *,
    forces: Mapping[str, tuple] | None = None,
    configurations: int = 3,
) -> Figure:
    """Draws linkages side by side, each with a few configurations and its tip's path.

    **Arguments:** `motions`: title -> (linkage, its solution); `forces`: title ->
    elements to draw, as in `draw_linkage`; `configurations`: number for each, from the
    first sample (faint) to the last.
    """
    count = whole_number("configurations", configurations, 2, np.iinfo(np.int32).max)
    geometries = _geometries(motions, forces)
    fig, panels = _panels(geometries, fig)
    for ax, (ts, g) in zip(panels, geometries.values()):
        indices = np.linspace(0, len(ts) - 1, count).round().astype(int)
        draw_motion(ax, g, np.unique(indices), mass_centers=False)
    figure_legend(fig)
    return fig


def animate(
    linkage: Linkage,
    solution: Solution,
    ax: Axes | None = None,
    *,
    forces: tuple = (),
    until: float | None = None,
    fps: float = 25,
    speed: float = 1.0,
    max_frames: int = 250,
) -> FuncAnimation:
    """Animates a motion, with the path of the tip so far.

    Each frame shows the nearest sample. A motion that needs more than `max_frames` has
    fewer frames per second.

    **Arguments:** `forces`: elements to draw, as in `draw_linkage`; `until`: last time,
    by default the solution's [s]; `fps`: frames per second; `speed`: 2 plays twice as
    fast.

    **Returns:** the animation, which you must keep until it is shown; last in a
    notebook's cell, it plays. `.save("motion.gif")` writes it, and with ffmpeg
    `.save("motion.mp4")`.
    """
    ts, q, _ = reached(linkage, solution)
    shown = ts <= _last(ts, until)
    ts, q = ts[shown], q[shown]
    times, pause = _frame_times([ts], fps, speed, max_frames)
    g = geometry(linkage, q, ts, forces)
    panel = plane_axes(ax, g.all_points, width=4.8, beside=1.3)
    return _animation([panel], [(ts, g)], times, pause, panel.set_title, ax is None)


def animate_grid(
    motions: Mapping[str, tuple[Linkage, Solution]],
    fig: Figure | None = None,
    *,
    forces: Mapping[str, tuple] | None = None,
    fps: float = 25,
    speed: float = 1.0,
    max_frames: int = 250,
) -> FuncAnimation:
    """Animates linkages side by side; a linkage whose motion has ended stands still.

    **Arguments:** `motions`, `forces`: as in `topology_grid`; the others as in
    `animate`.
    """
    geometries = _geometries(motions, forces)
    pairs = list(geometries.values())
    times, pause = _frame_times([ts for ts, _ in pairs], fps, speed, max_frames)
    figure, panels = _panels(geometries, fig)
    say = partial(figure.suptitle, x=0.02, ha="left")  # the legend is on the right
    return _animation(panels, pairs, times, pause, say, fig is None)


def _geometries(
    motions: Mapping[str, tuple[Linkage, Solution]], forces: Mapping[str, tuple] | None
) -> dict[str, tuple[np.ndarray, Geometry]]:
    """Times and geometry of each motion and its elements, by title."""
    filled_mapping("motions", motions, "(Linkage, Solution)")
    if forces is not None:
        filled_mapping("forces", forces, "force elements")
    forces = forces or {}
    if unknown := forces.keys() - motions.keys():
        raise refusal("forces", f"titles of motions, {list(motions)}", sorted(unknown))
    geometries = {}
    for title, pair in motions.items():
        name = f"motions[{shown(title)}]"
        fits = isinstance(pair, tuple) and len(pair) == 2
        if not (fits and isinstance(pair[0], Linkage)):
            raise refusal(name, "(Linkage, Solution)", pair)
        ts, q, _ = reached(pair[0], pair[1], name)
        geometries[title] = ts, geometry(pair[0], q, ts, forces.get(title, ()))
    return geometries


def _panels(
    geometries: dict[str, tuple[np.ndarray, Geometry]], fig: Figure | None
) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of axes of equal limits, one per motion."""
    count = len(geometries)
    columns = min(4, count)
    rows = -(-count // columns)
    points = np.concatenate([g.tip for _, g in geometries.values()])
    width, height = map(np.ptp, xy(points))
    high = np.clip(height / max(width, 1e-9), 0.4, 1.6)
    fig = figure_or_new(fig, 1.3 + 2 * columns, 0.6 + (0.6 + 1.8 * high) * rows)
    panels = []
    for position, title in enumerate(geometries):
        first = panels[0] if panels else None
        ax = fig.add_subplot(rows, columns, position + 1, sharex=first, sharey=first)
        plane_axes(ax, points)
        ax.set_title(fill(title, 18), fontsize="medium")  # no wider than its panel
        ax.set(xlabel="", ylabel="")
        ax.tick_params(
            labelbottom=position + columns >= count, labelleft=position % columns == 0
        )
        panels.append(ax)
    fig.supxlabel("x [m]", fontsize="medium")
    fig.supylabel("y [m]", fontsize="medium")
    return fig, panels


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
    say: Callable[..., Artist],
    new: bool,
) -> FuncAnimation:
    """Animates motions in panels of a `new` or given figure; `say` writes the time."""
    moving = []
    for ax, (ts, g) in zip(panels, motions):
        samples = np.array([np.abs(ts - t).argmin() for t in times])
        moving.append((g, draw_motion(ax, g, samples[:1], mass_centers=True), samples))
        ax.update_datalim(np.column_stack(xy(g.all_points)))  # of all samples

    def show(frame: int) -> Artist:
        for g, drawn, samples in moving:
            drawn.move(g, samples[frame : frame + 1])
        return say(f"t = {times[frame]:.2f} s", fontsize="medium")

    artists = [line for _, drawn, _ in moving for line in drawn.lines] + [show(0)]
    figure = figure_of(panels[0])
    if new or len(panels) > 1:
        figure_legend(figure)
    figure.draw_without_rendering()
    for ax in panels:
        ax.autoscale(False)
    if new:
        figure.draw_without_rendering()  # the layout of the limits just fixed
        figure.set_layout_engine("none")  # a layout per frame takes half the time
    return _MotionAnimation(figure, show, len(times), pause, artists)


class _MotionAnimation(FuncAnimation):
    """An animation that a notebook plays."""

    def __init__(
        self, figure: Figure, show: Callable[[int], Artist], count: int, pause: float,
        moving: list[Artist],
    ):  # fmt: skip
        super().__init__(figure, show, count, interval=pause, cache_frame_data=False)  # type: ignore[arg-type]
        self._figure, self._show = figure, show
        self._count, self._pause, self._moving = count, pause, moving

    def save(self, filename: str | Path, *args: Any, **kwargs: Any) -> None:
        """Writes a file with a progress bar; of a GIF it redraws only moving parts."""
        name = Path(filename).name
        if args or "writer" in kwargs:  # a notebook's, too, which shows no bar
            return super().save(filename, *args, **kwargs)
        kwargs.setdefault("progress_callback", partial(_progress, name))
        if not name.endswith(".gif"):
            return super().save(filename, **kwargs)
        self._draw_was_started = True  # matplotlib warns of what is never shown
        first, *others = self._images(kwargs["progress_callback"], kwargs.get("dpi"))
        # The format counts hundredths of a second; rounding each pause would add up.
        ends = np.round(self._pause / 10 * np.arange(self._count + 1))
        pauses = (10 * np.diff(ends).astype(int)).tolist()
        first.save(
            filename, save_all=True, append_images=others, duration=pauses, loop=0
        )

    def _images(
        self, progress: Callable[[int, int], object] | None, dpi: float | None
    ) -> Iterator[Image.Image]:
        """Draws the frames over one picture of what stands still."""
        figure = self._figure
        before, figure.dpi = figure.dpi, dpi or figure.dpi
        canvas = FigureCanvasAgg(figure)
        for artist in self._moving:
            artist.set_animated(True)
        canvas.draw()
        still = canvas.copy_from_bbox(figure.bbox)
        for frame in range(self._count):
            self._show(frame)
            canvas.restore_region(still)
            for artist in self._moving:
                figure.draw_artist(artist)
            image = Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB")
            yield image.quantize(
                method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
            )
            if progress is not None:
                progress(frame, self._count)
        for artist in self._moving:
            artist.set_animated(False)
        figure.dpi = before

    def to_jshtml(self, *args: Any, **kwargs: Any) -> str:
        plt.close(self._figure)  # otherwise a notebook also shows the still figure
        return super().to_jshtml(*args, **kwargs)

    def __repr__(self) -> str:
        return "an animation"  # without an address, the same in each run of a notebook

    def _repr_html_(self) -> str:
        return self.to_jshtml()


def _progress(name: str, frame: int, frames: int) -> None:
    done = 30 * (frame + 1) // frames
    # In a file each new bar would follow the last.
    if done > 30 * frame // frames and (done == 30 or sys.stderr.isatty()):
        bar, end = "#" * done + "." * (30 - done), "\n" if done == 30 else ""
        print(f"\r{name} [{bar}]", end=end, file=sys.stderr, flush=True)
