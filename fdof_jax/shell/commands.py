"""The commands of `fdof-jax`, which print results and return the pictures' paths.

Pictures are written into an existing folder. Arguments have already been checked as far
as possible without JAX.
"""

from pathlib import Path
from typing import Any

import equinox as eqx
import matplotlib

from .. import scenes
from ..data.files import load, save
from ..references.circle import CircleTask
from ..simulation.scene import Scene
from ..tuning.ensembles import perturbed
from ..tuning.gradient_quality import gradient_report
from ..tuning.league import circle_scenes, league_table
from ..tuning.losses import Tracking, tip_errors
from ..tuning.result import TuneResult
from ..tuning.tuning import tune, tune_each
from ..xla.configuration import configure
from . import showcase
from .tuning_run import Job


def set_up() -> None:
    """Sets up JAX and matplotlib for a process that only runs commands."""
    matplotlib.use("agg")  # pictures are written, never shown
    configure(x64=True)


def run_circle(output: Path) -> list[Path]:
    """Tracks Fig 7's circle, tunes the gains, and tracks the circle again."""
    run = showcase.run_circle(output, _say, print)
    _print_circle(run)
    return run.pictures


def run_figures(output: Path) -> list[Path]:
    """Reproduces the paper's Figs 3 to 7."""
    return showcase.run_figures(output, _say)


def run_topologies(output: Path) -> list[Path]:
    """Simulates all seven topologies in one compiled call."""
    solutions, picture = showcase.run_topologies(output, _say)
    for topology, (_, solution) in solutions.items():
        print(f"  {topology}: {int(solution.stats['num_steps'])} steps")
    return [picture]


def run_league() -> None:
    """Tunes the gains of all seven topologies on one circle."""
    _say("tune all seven topologies in one compiled program")
    results = tune_each(circle_scenes(), report=print)
    print(f"\n{league_table(results)}")


def run_tuning(
    output: Path,
    job: Job,
    resume: Path | None,
    save_to: Path | None,
    search: dict[str, Any],
) -> list[Path]:
    """Tunes the gains of a job, or resumes a saved run where it stopped.

    **Arguments:** `search`: method, starts, seed and max_steps of `tune`. A resumed run
    keeps settings that are not given, except the seed, which is increased by one for
    other random starts.

    **Raises:** ValueError as `tune` and `load`.
    """
    earlier: list[TuneResult] = []
    if resume is not None:
        _say(f"continue from {resume}")
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
    scene = _scene(job)
    _say("tune the gains (compiling first, some ten seconds)")
    last = earlier[-1] if earlier else None
    start = last.scene if last else scene
    result = tune(
        start,
        factor=None if last else job.factor,
        bounds=(last.lower, last.upper) if last else None,
        loss=Tracking(effort=job.price) if job.price > 0 else tip_errors,
        ensemble=_ensemble(job, scene),
        over="mean" if job.over == "nominal" else job.over,
        report=print,
        **search,
    )
    if save_to is not None:
        results = [*earlier, result]
        save(save_to, {"job": job, "search": search, "results": results})
    _say("compare the gradients with differences (compiling again)")
    reports = gradient_report(start), gradient_report(result.scene)
    _say("draw")
    first, second = map(showcase.simulate_finely, (start, result.scene))
    pictures = showcase.draw_circle(output, start, first, result, second)
    print(f"\n{result}")
    for when, report in zip(("before", "after"), reports):
        print(f"\n{when} tuning: {report}")
    return pictures


def _scene(job: Job) -> Scene:
    """The nominal scene: Fig 7's arm on the job's circle, for two turns."""
    scene = scenes.fig7()
    task = CircleTask(center=job.center, radius=job.radius, period=job.period)
    controller = eqx.tree_at(lambda c: c.reference, scene.forces[0], task)
    return scene._replace(forces=(controller,), t1=2 * abs(job.period))


def _ensemble(job: Job, scene: Scene) -> Scene | None:
    """The ensemble of the job's variations of the nominal scene, or None."""
    if job.over == "nominal":
        return None
    return perturbed(
        scene,
        job.members,
        payload=job.payload,
        start_offset=job.start_offset,
        speed=job.speed,
        link_error=job.link_error,
    )


def _say(text: str) -> None:
    print(f"{text} ...", flush=True)


def _print_circle(run: showcase.CircleRun) -> None:
    before, after = run.before, run.after
    joints = "T2", "F2", "T4"
    kp_units, kd_units = (
        ("N m/rad", "N/m", "N m/rad"),
        ("N m s/rad", "N s/m", "N m s/rad"),
    )
    rows = [
        ("tip error, whole run: rms [mm]", 1e3 * before.rms, 1e3 * after.rms),
        ("  largest [mm]", 1e3 * before.largest, 1e3 * after.largest),
        ("second period: rms [mm]", 1e3 * before.rms_second, 1e3 * after.rms_second),
        ("  largest [mm]", 1e3 * before.largest_second, 1e3 * after.largest_second),
    ]
    for k, joint in enumerate(joints):
        rows.append((f"kp of {joint} [{kp_units[k]}]", before.kp[k], after.kp[k]))
    for k, joint in enumerate(joints):
        rows.append((f"kd of {joint} [{kd_units[k]}]", before.kd[k], after.kd[k]))
    for k, joint in enumerate(joints):
        share = 100 * before.saturated[k], 100 * after.saturated[k]
        rows.append((f"time at the limit of {joint} [%]", *share))
    print(f"\n{'':34}{'paper':>12}{'tuned':>12}")
    for label, first, second in rows:
        print(f"{label:34}{first:12.5g}{second:12.5g}")
    history = run.tuned.history
    print(
        f"\ntuning: {len(history.loss) - 1} iterations, {run.tuned.message}; projected "
        f"gradient {history.gradient_norm[0]:.2g} -> {history.gradient_norm[-1]:.2g}"
    )
    times = ", ".join(
        f"{what} {seconds:.1f} s" for what, seconds in run.wall_times.items()
    )
    print(f"time, compilation included: {times}")
