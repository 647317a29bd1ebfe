"""Interleaved timing, and its records.

A `Case` is one contestant at one setting. `measure` runs all cases in turn, round after
round, so that other work of the machine affects all of them alike. Ratios are taken
within a round. A result is judged once, by its error, before anything is timed.
"""

import math
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

SAMPLE = 0.02  # least work per sample [s]
LONG = 1.0  # calls of this length [s] are measured in the fewest rounds
ENDLESS = 30.0  # first calls of this length [s] are not repeated to learn their length
FEWEST, MANY = 3, 15  # rounds: of long calls and under any budget, of the rest
WORST_ERROR = 0.1  # a larger error is a failure, not a result
EXACT = 1e-12  # a smaller error of joints that are held is as good as none [m or rad]
# The outcomes of a hard case, best first.
OUTCOMES = ("solved", "refused as asked", "failed by name", "failed silently")


class Skipped(Exception):
    """Raised if a contestant is not installed; the message names what is missing."""


class Case(NamedTuple):
    """A contestant at one setting.

    - `run`: does the work once; the timer waits for its result.
    - `judge`: returns what is known of the result: `error`, and possibly
      `steps`, `rejected`, `status`.
    - `fields`: further fields of its record.
    """

    solver: str
    setting: float | None
    run: Callable[[], Any]
    judge: Callable[[Any], dict] = lambda result: {"error": None}
    kind: str = "tolerance"
    fields: dict = {}


# `kind` is that of the setting, tolerance or step; `times` has an entry per round.
_NAMES = (
    "protocol", "problem", "solver", "kind", "setting", "steps", "rejected", "error",
    "time_min", "time_median", "time_quartiles", "times", "ratio", "ratio_quartiles",
    "ratio_to", "dtype", "compile_time", "reason",
)  # fmt: skip
RECORD = dict.fromkeys(_NAMES) | {"batch": 1, "status": "ok"}


def record(**fields: Any) -> dict:
    """Returns a complete record: one JSON line."""
    dtype = "float64" if jax.config.jax_enable_x64 else "float32"
    return {**RECORD, "dtype": dtype, **environment(), **fields}


def skipped(protocol: str, solver: str, reason: str) -> dict:
    print(f"{protocol}: {solver} skipped: {reason}", flush=True)
    return record(protocol=protocol, solver=solver, status="skipped", reason=reason)


def _timed(run: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    result = jax.block_until_ready(run())
    return time.perf_counter() - began, result


def _verdict(case: Case, result: Any) -> dict:
    known = case.judge(result)
    error = known.get("error")
    if known.get("status", "ok") == "ok" and error is not None:
        if not error <= WORST_ERROR:  # NaN included
            known = {**known, "status": "failed", "reason": f"error {error:.3g}"}
    return known


def measure(
    protocol: str,
    cases: Sequence[Case],
    *,
    budget: float,
    rounds: int = MANY,
    ratio_to: str | None = None,
    **fields: Any,
) -> list[dict]:
    """Returns records of all cases. Failed cases are not timed.

    **Arguments:**

    - `budget`: time after the first three rounds after which no other begins [s].
    - `ratio_to`: the solver with one case whose time divides all others, in each round.
    - `fields`: fields that all records share.
    """
    points, running = [], []
    for case in cases:
        point = record(
            protocol=protocol,
            solver=case.solver,
            setting=case.setting,
            kind=case.kind,
            **{**fields, **case.fields},
        )
        points.append(point)
        try:
            first, result = _timed(case.run)
            point.update(_verdict(case, result))
            again = first if first > ENDLESS else _timed(case.run)[0]
        except Exception as failure:  # a peer may raise anything: it has failed
            point.update(status="failed", reason=f"{type(failure).__name__}: {failure}")
            point["reason"] = point["reason"].split("\n")[0][:200]
        else:
            if again != first:
                point["compile_time"] = max(0.0, first - again)
        if point["status"] != "ok":
            setting = "" if case.setting is None else f" at {case.setting:g}"
            print(f"{protocol}: {case.solver}{setting} failed: {point['reason']}")
            continue
        point["times"] = []
        calls = max(1, math.ceil(SAMPLE / again))
        running.append((case, point, calls, FEWEST if again > LONG else rounds))
    for done in range(rounds):
        if done <= FEWEST:
            began = time.perf_counter()
        elif time.perf_counter() - began > budget:
            break
        for case, point, calls, most in running:
            if done < most:
                start = time.perf_counter()
                for _ in range(calls):
                    jax.block_until_ready(case.run())
                point["times"].append((time.perf_counter() - start) / calls)
    for point in points:
        if point["times"]:
            low, median, high = np.percentile(point["times"], [25, 50, 75])
            point["time_min"] = min(point["times"])
            point["time_median"] = median
            point["time_quartiles"] = [low, high]
    if ratio_to is not None:
        _add_ratios(points, ratio_to)
    return points


def _add_ratios(points: list[dict], ratio_to: str) -> None:
    baseline = [p for p in points if p["solver"] == ratio_to and p["times"]]
    for point in points if baseline else ():
        if point["times"]:
            against = np.array(baseline[0]["times"])
            shared = min(len(against), len(point["times"]))
            ratio = np.array(point["times"][:shared]) / against[:shared]
            low, median, high = np.percentile(ratio, [25, 50, 75])
            point.update(ratio=median, ratio_quartiles=[low, high], ratio_to=ratio_to)


def worst(found: dict) -> float:
    """Returns the larger of error and drift."""
    return max(found["error"] or 0.0, found.get("drift") or 0.0)


def envelope(errors: Sequence[float], times: Sequence[float], error: float) -> float:
    """Returns the least time for an error, between points on logarithmic axes.

    Only points that no other point beats in both count. For a looser error than any
    of theirs the result is the time of the loosest point, an upper bound; for a
    tighter error than any it is NaN.
    """
    front: list[tuple[float, float]] = []
    for e, t in sorted(zip(errors, times)):  # from the tightest: each must be faster
        if not front or t < front[-1][1]:
            front.append((e, t))
    if not front or not error >= front[0][0]:
        return math.nan
    # An error of exactly zero has no logarithm; far below any target is enough.
    e, t = np.log(np.maximum(np.array(front), 1e-300)).T
    return float(np.exp(np.interp(np.log(max(error, 1e-300)), e, t)))


def times_at(points: list[dict], error: float) -> np.ndarray | None:
    """Returns one solver's time at an error for each round; None if not reached."""
    good = [p for p in points if p["status"] == "ok" and p["times"]]
    if not good or error is None:
        return None
    rounds = min(len(p["times"]) for p in good)
    errors = [p["error"] for p in good]
    walls = [envelope(errors, [p["times"][i] for p in good], error)
             for i in range(rounds)]  # fmt: skip
    return None if np.isnan(walls).any() else np.array(walls)


@cache
def environment() -> dict:
    """Returns the machine and versions, the same for all records of a process."""
    names = "jax", "jaxlib", "diffrax", "numpy", "mujoco", "heyoka"
    versions = {"python": platform.python_version()}
    for name in names:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    cpu = next(_cpu_models(), platform.processor())
    return {
        "cores": len(os.sched_getaffinity(0)),
        "device": jax.devices()[0].platform,
        "device_kind": jax.devices()[0].device_kind,
        "versions": versions,
        "cpu": cpu,
        "load": os.getloadavg()[0],
        "commit": _commit(),
        "date": time.strftime("%Y-%m-%d"),
    }


def _cpu_models() -> Iterator[str]:
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else ():
        if line.startswith("model name"):
            yield line.split(":", 1)[1].strip()


def _commit() -> str | None:
    """Returns the commit; "-dirty" if anything but the results has changed."""
    changed = _git("status", "--porcelain", "--", ":/", ":!results", ":!README.md")
    return f"{_git('rev-parse', '--short', 'HEAD')}{'-dirty' if changed else ''}"


def _git(*arguments: str) -> str | None:
    try:
        output = subprocess.run(
            ["git", *arguments],
            capture_output=True,
            text=True,
            cwd=Path(__file__).parent,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return output.stdout.strip()
