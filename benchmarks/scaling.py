"""Growth of cost: log-log slopes against batch, horizon, 1/error and gain."""

from collections.abc import Iterator

import numpy as np

import fdof_jax as fj

from . import contestants as own
from .contestants import cases
from .measure import Case, measure
from .problems import Problem, fig5, fig5_batch, fig7, reference

PROTOCOL = "scaling"
TOLERANCE = 1e-8


def _batches(quick: bool) -> Iterator[tuple[float, Problem, float]]:
    for batch in (16, 64) if quick else (64, 256, 1024, 4096):
        yield batch, fig5_batch(batch), TOLERANCE


def _horizons(quick: bool) -> Iterator[tuple[float, Problem, float]]:
    for horizon in (1, 2) if quick else (1, 2, 4, 8):
        ts = np.linspace(0, horizon, 101)
        yield horizon, fig5()._replace(ts=ts), TOLERANCE


def _errors(quick: bool) -> Iterator[tuple[float, Problem, float]]:
    problem = fig5()._replace(ts=np.linspace(0, 2, 101))
    for tolerance in (1e-6, 1e-9) if quick else (1e-6, 1e-8, 1e-10, 1e-12):
        yield tolerance, problem, tolerance


def _gains(quick: bool) -> Iterator[tuple[float, Problem, float]]:
    """Returns Fig 7 without limits: kp and kd times a factor and its root."""
    problem = fig7()._replace(ts=np.linspace(0, 4, 101))
    (pd,) = problem.forces
    for factor in (1, 10) if quick else (0.1, 1, 10, 100):
        stiffer = fj.PDController(
            pd.kp * factor, pd.kd * factor**0.5, np.inf, pd.reference
        )
        yield factor, problem._replace(forces=(stiffer,)), TOLERANCE


SERIES = {"batch": _batches, "horizon": _horizons, "error": _errors, "gain": _gains}


def slope(points: list[dict]) -> float | None:
    """Returns the exponent of time against `x`, by least squares on logarithms."""
    good = [p for p in points if p["status"] == "ok" and p["times"]]
    if len(good) < 2:
        return None
    x, t = np.log([[p["x"], p["time_median"]] for p in good]).T
    return float(np.polyfit(x, t, 1)[0])


def run(quick: bool) -> Iterator[dict]:
    for series, members in SERIES.items():
        prepared: list[Case] = []
        for x, problem, tolerance in members(quick):
            contestant = own.fdof_jax(problem)
            (case,) = cases(contestant, (tolerance,), reference(problem), problem)
            prepared.append(case._replace(fields={"x": x, "batch": problem.batch or 1}))
        points = measure(PROTOCOL, prepared, budget=3 if quick else 8, problem=series)
        if series == "error":
            for point in points:
                point["x"] = 1 / point["error"] if point["error"] else None
        yield from points
