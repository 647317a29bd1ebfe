"""Animations: the frames of motions, and files of them."""

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from PIL import Image

from ..base.checks import real_array, whole_number
from .arms import Geometry, draw_motion
from .axes import figure_legend, xy


class MotionAnimation(FuncAnimation):
    """An animation that a notebook plays if it is the last line of a cell."""

    def __init__(
        self, figure: Figure, show: Any, count: int, pause: float, moving: list[Artist]
    ):
        super().__init__(figure, show, count, interval=pause, cache_frame_data=False)  # type: ignore[arg-type]
        self._figure, self._show = figure, show
        self._count, self._pause, self._moving = count, pause, moving

    def save(self, filename: Any, *args: Any, **kwargs: Any) -> None:
        """Writes a file, and a progress bar to the standard error output.

        By default a GIF is written by pillow, and only what moves is drawn again.
        """
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

    def _images(self, progress: Any, dpi: float | None) -> Iterator[Image.Image]:
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


def frame_times(
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


def animation_of(
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

    def show(frame: int) -> Artist:
        for g, drawn, samples in moving:
            drawn.move(g, samples[frame : frame + 1])
        return say(f"t = {times[frame]:.2f} s", fontsize="medium")

    artists = [line for _, drawn, _ in moving for line in drawn.lines] + [show(0)]
    figure = panels[0].get_figure(root=True)
    assert figure is not None  # axes are always in a figure
    if new or len(panels) > 1:
        figure_legend(figure)
    figure.draw_without_rendering()
    for ax in panels:
        ax.autoscale(False)
        ax.set_adjustable("box")
    if new:
        figure.draw_without_rendering()  # the layout of the limits just fixed
        figure.set_layout_engine("none")  # a layout per frame takes half the time
    return MotionAnimation(figure, show, len(times), pause, artists)
