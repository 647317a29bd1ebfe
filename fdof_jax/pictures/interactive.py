"""Sliders for a notebook, and the picture they redraw."""

from base64 import b64encode
from collections.abc import Mapping
from io import BytesIO
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave

from ..base.checks import instance, optional_package, refusal, shown
from ..base.report import html_table
from ..linkage.linkage import joint_names, joints_of
from ..references.reference import reference_of
from ..scenes import circle_scenes
from ..simulation.scene import Scene
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from ..steps.looped_dopri8 import LoopedDopri8
from ..tuning.losses import controller_of, gains_of, with_gains
from .arms import draw_motion, geometry
from .axes import SERIES, filled_mapping, legend, plane_axes, reached, xy
from .elements import COMMANDED

__all__ = ["sliders"]


def __dir__() -> list[str]:
    return __all__


_SAMPLES = 201
_CONFIGURATIONS = 5  # drawn of each motion
# As accurate as a picture can show, and fast enough for a moving slider.
_TOLERANCE, _MAX_STEPS = 1e-5, 4096


class _Moved(NamedTuple):
    """A scene as set by the sliders, and its motion."""

    scene: Scene
    solution: Solution
    commanded: Array  # path (time, 2) [m]
    possible: Array  # whether the arm reaches the commanded path: (time,)


@eqx.filter_jit
def _moved(scene: Scene, stretch: Array, factor: Array) -> _Moved:
    """Simulates a scene with lengths * `stretch` (n,) and gains * `factor` (2, n).

    The solver compiles in half the time of the default within `jit`, that of batches.
    """
    length, com = scene.linkage.length, scene.linkage.com
    linkage = scene.linkage.replace(
        length=length.at[1:].multiply(stretch), com=com.at[:, 0].multiply(stretch)
    )
    gains = factor * gains_of(scene)
    scene = with_gains(scene._replace(linkage=linkage), gains)
    ts = jnp.linspace(0, scene.t1, _SAMPLES)
    solution = simulate(
        scene, ts, solver=LoopedDopri8(), rtol=_TOLERANCE, atol=_TOLERANCE,
        max_steps=_MAX_STEPS, throw=False,
    )  # fmt: skip
    task: Any = controller_of(scene).reference
    positions, _ = jax.vmap(lambda t: task(t, linkage))(ts)
    commanded = jax.vmap(task.tip)(ts)
    return _Moved(scene, solution, commanded, jnp.isfinite(positions).all(axis=1))


def _report(moved: _Moved, error: np.ndarray) -> str:
    """HTML text on the motion's end, gains and lengths; `error`: tip errors [m]."""
    solution = moved.solution
    if not np.all(moved.possible):
        from_time = float(solution.ts[np.argmin(moved.possible)])
        text = f"<b>The path is out of the arm's reach</b> from {from_time:.2f} s on."
    elif str(solution.outcome) != "successful":
        time = float(solution.stats["time_reached"])
        text = f"<b>Ended at {time:.2f} s: {solution.outcome}.</b>"
    else:
        text = f"Tip error: rms {1e3 * np.sqrt(np.mean(error**2)):.3g} mm."
    linkage, controller = moved.scene.linkage, controller_of(moved.scene)
    rows, of_joints = [], np.asarray(gains_of(moved.scene)).T
    parts = zip(joint_names(linkage), of_joints, linkage.length[1:])
    for k, (joint, gains, length) in enumerate(parts, start=1):
        units = controller.gain_units[joint[0]]
        texts = [f"{float(gain):.4g} {unit}" for gain, unit in zip(gains, units)]
        rows.append((joint, *texts, f"link {k}: {float(length):.3g} m"))
    return text + html_table(rows, ("joint", "kp", "kd", "length after it"))


class _Picture:
    """A picture of an arm with the path of its tip, and the tip's error over time.

    Axes, numbers and legend take most of the time to draw. They are kept as pixels as
    long as the motion fits into them, and the lines are moved, not drawn anew.
    """

    def __init__(self):
        self._figure = Figure(figsize=(7, 3.2), dpi=100)
        self._canvas = FigureCanvasAgg(self._figure)
        plane = self._figure.add_axes((0.1, 0.16, 0.43, 0.62))
        self._plane = plane_axes(plane, np.zeros(1))
        self._plane.set_aspect("equal", adjustable="datalim")
        self._time = self._figure.add_axes((0.64, 0.16, 0.34, 0.62))
        self._time.set(xlabel="time [s]", ylabel="tip error [mm]")
        for ax in self._figure.axes:
            ax.locator_params(nbins=5)
        self._background: Any = None
        self._lines: Any = None

    def draw(self, moved: _Moved) -> tuple[bytes, np.ndarray]:
        """The picture as PNG, and the tip's error [m]; all calls need one topology."""
        ts, q, _ = reached(moved.scene.linkage, moved.solution)
        path = geometry(moved.scene.linkage, q)
        commanded = np.asarray(moved.commanded) @ [1, 1j]
        error = np.abs(path.tip - commanded[: len(ts)])
        shown = np.linspace(0, len(ts) - 1, _CONFIGURATIONS).round().astype(int)

        if self._lines is None:
            (task,) = self._plane.plot([], label="commanded", **COMMANDED)
            arms = draw_motion(self._plane, path, shown, mass_centers=False)
            (errors,) = self._time.plot([], color=SERIES[0], lw=1.2)
            self._lines = task, arms, errors
        task, arms, errors = self._lines
        task.set_data(*xy(commanded))
        arms.move(path, shown)
        errors.set_data(ts, 1e3 * error)
        if self._background is None or not self._fits():
            self._draw_background(float(moved.solution.ts[-1]))
        self._canvas.restore_region(self._background)
        for ax in self._figure.axes:
            for line in ax.lines:
                ax.draw_artist(line)
        png = BytesIO()
        # Stronger compression costs more time than it saves in transfer.
        pixels, fast = self._canvas.buffer_rgba(), {"compress_level": 1}
        imsave(png, pixels, format="png", pil_kwargs=fast)
        return png.getvalue(), error

    def _fits(self) -> bool:
        for ax in self._figure.axes:
            ax.relim()
        motion, plane = self._plane.dataLim, self._plane.viewLim
        most, top = self._time.dataLim.y1, self._time.viewLim.y1
        inside = plane.x0 < motion.x0 and motion.x1 < plane.x1
        inside &= plane.y0 < motion.y0 and motion.y1 < plane.y1
        filled = max(motion.width / plane.width, motion.height / plane.height)
        return inside and filled > 0.5 and 0.3 * top < most < top

    def _draw_background(self, t1: float) -> None:
        for ax in self._figure.axes:
            ax.relim()
            for line in ax.lines:
                line.set_animated(True)  # left out of the background
        self._plane.autoscale()
        self._time.set(xlim=(0, t1), ylim=(0, 1.2 * self._time.dataLim.y1))
        legend(self._plane)
        self._canvas.draw()
        # New lines would move the view, but not the numbers in the background.
        self._plane.autoscale(False)
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)


def sliders(scenes: Mapping[str, Scene] | None = None) -> Any:
    """A box of sliders for a notebook, which simulate a controlled arm as they move.

    A drop-down chooses among the scenes. Sliders stretch the moving links, with their
    mass centres, to 0.5 to 1.5 of their length, and multiply the gains of the PD
    controller by 1/4 to 4. The left panel shows the arm at five times of its motion,
    with the path of its tip and the commanded path; the right panel shows the tip's
    error over time [mm]. The text below lists gains and lengths in their units, and
    reports how the motion ended. A motion that fails is drawn as far as it went.

    The first motion takes some seconds to compile. Scenes that differ in numbers only,
    as all topologies do, share the program. Motions are accurate to some 1e-5 m or rad.

    **Arguments:** `scenes`: name -> a scene with exactly one PD controller, tracking a
    task with a `tip`; by default `scenes.circle_scenes()`, one arm per topology.

    **Returns:** an ipywidgets `Box`, shown if it is the last line of a cell. Pages that
    cannot show it, as an exported notebook without the state of its widgets, show the
    picture as it was.

    **Raises:** ImportError without ipywidgets; ValueError for malformed arguments.
    """
    widgets = optional_package("ipywidgets", "notebook")
    options = {}
    scenes = circle_scenes() if scenes is None else scenes
    for name, scene in filled_mapping("scenes", scenes, "Scene").items():
        place = f"scenes[{shown(name)}]"
        instance(place, scene, Scene)
        task = controller_of(scene).reference
        if reference_of(task).tip is None:
            raise refusal(place, "a controller of a task with a tip", task)
        # As an array, so that other times do not compile again.
        options[name] = scene._replace(t1=jnp.asarray(scene.t1, float))

    sizes = {joints_of(scene.linkage) for scene in options.values()}
    if len(sizes) > 1:
        raise refusal("scenes", "arms of one number of joints", sizes)
    numbers = range(1, sizes.pop() + 1)
    arm = widgets.Dropdown(options=list(options), description="arm")
    lengths = [
        widgets.FloatSlider(1.0, min=0.5, max=1.5, step=0.01, description=f"link {n}")
        for n in numbers
    ]
    # A factor of 4, as in `tune`. The browser shows only whole steps from the least
    # value, so the factor 1 must lie on a step.
    most = np.log10(4)
    span = dict(min=-most, max=most, step=most / 30, readout_format=".2f")
    gains = [
        widgets.FloatLogSlider(1.0, description=f"{gain} {k}", **span)
        for gain in ("kp", "kd")
        for k in numbers
    ]
    image, words = widgets.Image(format="png"), widgets.HTML()
    pictures = {name: _Picture() for name in options}

    def redraw(change: object = None) -> None:
        stretch = jnp.array([slider.value for slider in lengths])
        factor = jnp.array([slider.value for slider in gains]).reshape(2, -1)
        moved = _moved(options[arm.value], stretch, factor)
        image.value, error = pictures[arm.value].draw(moved)
        words.value = _report(moved, error)

    redraw()
    # While a picture is drawn, the browser keeps only the newest value: no queue grows.
    for control in (arm, *lengths, *gains):
        control.observe(redraw, "value")
    of_lengths = widgets.HTML("Lengths of the links, times the scene's:")
    of_gains = widgets.HTML("Gains of the joints, times the scene's:")
    controls = widgets.VBox([arm, of_lengths, *lengths, of_gains, *gains])

    class Sliders(widgets.Box):
        """The box, with its first picture for pages that cannot show widgets."""

        def _repr_mimebundle_(self, **kwargs: Any) -> dict[str, Any]:
            still = {"image/png": b64encode(image.value).decode()}
            return super()._repr_mimebundle_(**kwargs) | still

    layout = widgets.Layout(flex_flow="row wrap")
    return Sliders([controls, widgets.VBox([image, words])], layout=layout)
