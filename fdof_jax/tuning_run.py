"""The run behind `fdof-jax tune`: set up or go on, tune, save, draw."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
from numpy.typing import ArrayLike

from . import scenes
from .control import CircleTask
from .ensembles import perturbed
from .files import load, save
from .gradient_quality import gradient_report
from .losses import Tracking, tip_errors
from .scenes import Scene
from .showcase import draw_circle, simulate_finely
from .tune_result import TuneResult
from .tuning import tune
from .validation import real_array


@dataclasses.dataclass(frozen=True)
class Job:
    """What is tuned: Fig 7's arm on a circle, and by what it is judged.

    `over`: "nominal", or "mean" or "worst" of an ensemble of `members`.
    """

    center: ArrayLike = (-4.0, 2.0)  # [m]
    radius: float = 0.75  # [m]
    period: float = 5.0  # [s]
    factor: float = 4.0  # of the paper's gains
    price: float = 0.0  # of effort [m^2]
    over: str = "nominal"
    members: int = 16
    payload: ArrayLike = (0.0, 2.0)  # [kg]
    start_offset: float = 0.3  # [m]
    speed: ArrayLike = (1.0, 2.0)
    link_error: float = 0.0

    def scene(self) -> Scene:
        scene = scenes.fig7()
        task = CircleTask(center=self.center, radius=self.radius, period=self.period)
        controller = eqx.tree_at(lambda c: c.reference, scene.forces[0], task)
        return scene._replace(forces=(controller,), t1=2 * abs(self.period))

    def ensemble(self, scene: Scene) -> Scene | None:
        if self.over == "nominal":
            return None
        return perturbed(
            scene,
            self.members,
            payload=self.payload,
            start_offset=self.start_offset,
            speed=self.speed,
            link_error=self.link_error,
        )


class TuningRun(NamedTuple):
    """A finished run: its result, the gradient reports before and after, pictures."""

    result: TuneResult
    reports: tuple[Any, Any]
    pictures: list[Path]


def run_tuning(
    output: Path,
    say: Callable[[str], None],
    report: Callable[[str], None],
    *,
    job: Job,
    resume: Path | None = None,
    save_to: Path | None = None,
    **search: Any,
) -> TuningRun:
    """Tune the gains of a job, or go on from where a saved one has come to.

    **Arguments:** `search`: method, starts, seed and max_steps of `tune`. Those not
    given are as they were in the run that goes on, but for the seed, which is one more:
    other random starts are tried.

    **Raises:** ValueError as `tune` and `load`.
    """
    # Before the work, not after it.
    if save_to is not None and not save_to.absolute().parent.is_dir():
        raise ValueError(
            f"--save: expected a file in a folder that is there, got {save_to}."
        )
    earlier: list[TuneResult] = []
    if resume is not None:
        say(f"go on from {resume}")
        saved = load(resume)
        if not isinstance(saved, dict) or set(saved) != {"job", "search", "results"}:
            raise ValueError(
                f"{resume}: expected a file written by `fdof-jax tune --save`, got one "
                f"that holds a {type(saved).__name__}."
            )
        job, earlier = saved["job"], saved["results"]
        search = {**saved["search"], "seed": saved["search"]["seed"] + 1, **search}
    else:
        search = {"seed": 0, **search}
    price = real_array("price", job.price, (), minimum=0)
    scene = job.scene()
    output.mkdir(parents=True, exist_ok=True)
    say("tune the gains (compiling first, some ten seconds)")
    last = earlier[-1] if earlier else None
    start = last.scene if last else scene
    result = tune(
        start,
        factor=None if last else job.factor,
        bounds=(last.lower, last.upper) if last else None,
        loss=Tracking(effort=price) if price > 0 else tip_errors,
        ensemble=job.ensemble(scene),
        over="mean" if job.over == "nominal" else job.over,
        report=report,
        **search,
    )
    if save_to is not None:
        results = [*earlier, result]
        save(save_to, {"job": job, "search": search, "results": results})
    say("compare the gradients with differences (compiling again)")
    reports = gradient_report(start), gradient_report(result.scene)
    say("draw")
    first, second = simulate_finely(start), simulate_finely(result.scene)
    pictures = draw_circle(output, start, first, result, second)
    return TuningRun(result, reports, pictures)
