"""The targets and the measured ratios, taken round by round."""

from collections.abc import Callable, Iterator

import numpy as np

from .compile_times import EMPTY, FILLED, PLAIN
from .measure import times_at


def _points(points: list[dict], solver: str, **fields) -> list[dict]:
    return [
        p
        for p in points
        if p["solver"] == solver and all(p.get(k) == v for k, v in fields.items())
    ]


def _per_round(above, below) -> np.ndarray | None:
    if above is None or below is None:
        return None
    rounds = min(len(above), len(below))
    return np.asarray(above)[:rounds] / np.asarray(below)[:rounds]


def ratio_at(points: list[dict], above: str, below: str, error: float, **fields):
    """Returns one solver's time at an error over another's, for each round."""
    return _per_round(
        times_at(_points(points, above, **fields), error),
        times_at(_points(points, below, **fields), error),
    )


def _ratio_of(points: list[dict], above: dict, below: dict):
    """Returns the ratio of two single points; None if one is missing or failed."""
    found = []
    for wanted in (above, below):
        match = [p for p in points if all(p.get(k) == v for k, v in wanted.items())]
        found.append(match[0]["times"] if match and match[0]["times"] else None)
    return _per_round(*found)


def _quartiles(ratio, number: Callable) -> tuple[str, str]:
    if ratio is None:
        return "not reached", ""
    low, median, high = np.percentile(ratio, [25, 50, 75])
    return number(median, 3), f"{number(low, 3)} to {number(high, 3)}"


def targets(points: dict[str, list[dict]], number: Callable) -> Iterator[tuple]:
    """Returns (figure, measured, quartiles, required, aim) of measured targets."""

    def row(figure: str, ratio, required: str, aim: str) -> tuple:
        return figure, *_quartiles(ratio, number), required, aim

    job = points.get("batches", ())
    for name in ("fdof_jax", "fdof_jax sweep") if job else ():
        yield row(
            f"batch 1024, worst error 1e-6: {name} over MuJoCo RK4 rollout",
            ratio_at(job, "MuJoCo RK4", name, 1e-6, batch=1024),
            "≥ 150",
            "≥ 500",
        )
        yield row(
            f"batch 1024, worst error 1e-9: {name} over plain diffrax",
            ratio_at(job, "plain diffrax", name, 1e-9, batch=1024),
            "≥ 10",
            "≥ 45",
        )
    if job:
        yield from _sweep_targets(job, row)
    if job := points.get("batches-two-cores"):
        yield row(
            "batch 16384, worst error 1e-9: sweep on two cores over one",
            ratio_at(
                job, "fdof_jax sweep, one core", "fdof_jax sweep", 1e-9, batch=16384
            ),
            "≥ 1.3",
            "≥ 1.7",
        )
    for problem in dict.fromkeys(p["problem"] for p in points.get("checks", ())):
        yield row(
            f"{problem}: watched for ill-conditioning over not watched",
            _ratio_of(
                points["checks"],
                {"solver": "watched", "problem": problem},
                {"solver": "not watched", "problem": problem},
            ),
            "≤ 1.03",
            "",
        )
    if job := points.get("generality"):
        here = {"problem": "RRR-rk4"}
        arrays = {"solver": "EF as arrays", **here}
        for figure, above, below, required, aim in (
            ("RK4 step, batch 1000: published form over fdof_jax",
             {"solver": "published: 12 states, 6x6", **here}, arrays, "≥ 20", "≥ 60"),
            ("RK4 step, batch 1000: fdof_jax over C",
             arrays, {"solver": "C RK4", **here}, "≤ 4", "≤ 1.5"),
            ("RK4 step, batch 1000: EF as arrays over known topology",
             arrays, {"solver": "topology known at compile time", **here},
             "≤ 1.2", "≤ 1.05"),
        ):  # fmt: skip
            yield row(figure, _ratio_of(job, above, below), required, aim)
    if job := points.get("mixed"):
        for plain in ("plain diffrax, reduced", "plain diffrax, masked 6x6"):
            yield row(
                f"mixed batch, worst error 1e-8: sweep over {plain}",
                ratio_at(job, plain, "fdof_jax sweep", 1e-8),
                "≥ 3",
                "≥ 6",
            )
    if job := points.get("lockstep"):
        for name in ("fdof_jax", "fdof_jax sweep"):
            for scene, required, aim in (
                ("one fast", "≤ 3", "≤ 1.5"),
                ("one NaN at the start", "≤ 1.5", "≤ 1.1"),
                ("one NaN mid-run", "≤ 1.5", "≤ 1.1"),
            ):
                clean = {"solver": f"{name}, clean"}
                other = {"solver": f"{name}, {scene}"}
                figure = f"{scene} in a batch of 256 over the clean batch: {name}"
                yield row(figure, _ratio_of(job, other, clean), required, aim)
    if job := points.get("single_arms"):
        problem = "Fig 5, 10 s, error up to 2 s"
        yield row(
            "Fig 5, 10 s, error 1e-9 at 2 s: fdof_jax over heyoka",
            ratio_at(job, "fdof_jax", "heyoka", 1e-9, problem=problem),
            "≤ 2",
            "≤ 1.3",
        )
        limits = {"forward": ("≤ 6", "≤ 3"), "reverse": ("≤ 12", "≤ 6")}
        yield from _gradient_targets(job, number, "Fig 7, 4 s, six gains", 1, limits)
    if job := points.get("gradients"):
        limits = dict.fromkeys(("forward", "reverse"), ("≤ 8", "≤ 4"))
        yield from _gradient_targets(job, number, "gains", 256, limits)
    if job := points.get("compile_times"):
        for figure, case, how, seconds, required, aim in (
            ("first motion [s of CPU]", "Fig 5", PLAIN, "times", "≤ 3.5", ""),
            ("first motion [s of CPU]", "Fig 7", PLAIN, "times", "≤ 5.5", ""),
            ("first motion [s of CPU]", "three elements", PLAIN, "times", "≤ 6", ""),
            ("first motion [s of CPU]", "Fig 5", FILLED, "times", "≤ 2", ""),
            ("first motion [s of CPU]", "Fig 7", FILLED, "times", "≤ 2.5", ""),
            ("first motion [s of CPU]", "three elements", FILLED, "times", "≤ 3", ""),
            ("first call [s of CPU]", "value and gradient, forward", EMPTY,
             "first_calls", "≤ 7", "≤ 4"),
            ("first call [s of CPU]", "value and gradient, reverse", EMPTY,
             "first_calls", "≤ 7", "≤ 4"),
            ("first call [s of CPU]", "tune Fig 7", EMPTY, "first_calls", "≤ 6", ""),
            ("second call [s]", "tune Fig 7", EMPTY, "again", "≤ 0.2", ""),
        ):  # fmt: skip
            found = [p for p in job if (p["problem"], p["solver"]) == (case, how)]
            times = found[0][seconds] if found and found[0]["times"] else None
            yield row(f"{figure}: {case}, {how}", times, required, aim)
    if job := points.get("drift"):
        dopri8 = [p for p in job if p["solver"].startswith("fdof_jax") and p["times"]]
        best = min(dopri8, key=lambda p: p["energy_defect"], default=None)
        if best:
            figure = (
                f"{best['problem']}, energy drift [J]: {best['solver']}, "
                f"{best['kind']} {best['setting']:g}, "
                f"{number(best['time_median'], 3)} s"
            )
            yield figure, number(best["energy_defect"]), "", "≤ 1e-10", "≤ 1e-12"


def _sweep_targets(job: list[dict], row: Callable) -> Iterator[tuple]:
    """Returns the rates of sweeps over others, and what a small sweep costs more."""
    name = "fdof_jax sweep"
    version = [int(part) for part in job[0]["versions"]["jax"].split(".")[:2]]
    least = "≥ 0.8" if version < [0, 12] else "≥ 1"
    for error in (1e-6, 1e-9):
        yield row(
            f"batch 1024, worst error {error:g}: sweep over heyoka",
            ratio_at(job, "heyoka", name, error, batch=1024),
            least,
            "≥ 1.5",
        )
    yield row(
        "batch 1024, worst error 1e-9: sweep over vmap",
        ratio_at(job, "fdof_jax", name, 1e-9, batch=1024),
        "≥ 1",
        "",
    )
    few = [
        times_at(_points(job, solver, batch=16), 1e-9) for solver in (name, "fdof_jax")
    ]
    longer = None
    if not any(times is None for times in few):
        rounds = min(map(len, few))
        longer = 1e3 * (few[0][:rounds] - few[1][:rounds])
    yield row("batch 16, worst error 1e-9: sweep - vmap [ms]", longer, "≤ 1", "")


def _gradient_targets(
    job: list[dict],
    number: Callable,
    problem: str,
    batch: int,
    limits: dict[str, tuple[str, str]],
) -> Iterator[tuple]:
    for mode, (required, aim) in limits.items():
        same = {"problem": problem, "batch": batch, "horizon": 4.0, "setting": 1e-8}
        this = {**same, "gradient_mode": mode}
        ratio = _ratio_of(job, this, {**same, "gradient_mode": "none"})
        found = [p for p in job if all(p.get(k) == v for k, v in this.items())]
        error = number(found[0]["error"]) if found else "-"
        yield (
            f"6-gain value and gradient over forward, {mode} mode, batch {batch}, "
            f"gradient error {error}",
            *_quartiles(ratio, number),
            f"{required}, error ≤ 1e-6",
            aim,
        )
