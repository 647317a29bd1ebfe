"""The hard cases on four engines: solved, reported as unsolvable, or failed."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from .hard_engines import ENGINES, Refused, error_of, mujoco
from .hard_probes import PLAIN, TESTS, probed, tested
from .hard_scenes import HardScene, motions
from .measure import OUTCOMES, Skipped, record

PROTOCOL = "hard_cases"
ROUNDS = 1
LONGEST = 5.0  # no run is repeated after this time [s]

SOLVED, REFUSED, BY_NAME, SILENTLY = OUTCOMES


def outcome(scene: HardScene, make: Callable) -> dict:
    """Returns the outcome of one scene on one engine, as fields of a record."""
    times: list[float] = []
    try:
        run = make(scene)
        while len(times) <= ROUNDS and sum(times) < LONGEST:
            began = time.perf_counter()
            result = run()
            times.append(time.perf_counter() - began)
    except Skipped as reason:
        return {"status": "skipped", "reason": str(reason)}
    except Refused as refusal:
        named = scene.may_refuse and str(refusal) == "ill-conditioned"
        return {"status": REFUSED if named else BY_NAME, "reason": str(refusal)}
    except Exception as failure:
        reason = f"{type(failure).__name__}: {failure}".split("\n")[0][:200]
        return {"status": BY_NAME, "reason": reason}
    first, *later = times
    later = later or [first]
    known = {
        "error": error_of(scene, result),
        "steps": result.steps,
        "times": later,
        "time_min": min(later),
        "time_median": float(np.median(later)),
        "compile_time": max(0.0, first - min(later)),
    }
    if make is not mujoco and (result.steps or 0) > scene.most_steps:
        return {**known, "status": SILENTLY, "reason": "too many steps"}
    right = known["error"] <= scene.bound
    return {**known, "status": SOLVED if right else SILENTLY}


def run(quick: bool) -> Iterator[dict]:
    """Returns a record per scene and engine: `number`, `bound`, status (outcome)."""
    for scene in motions():
        if quick and scene.number > 3:
            return
        for engine, make in ENGINES.items():
            found = outcome(scene, make)
            yield _record(scene.number, scene.name, engine, scene.bound, found)
    for number, (name, file, which) in TESTS.items():
        yield _record(number, name, "fdof_jax", None, tested(file, which))
        if number in PLAIN:
            probe, bound = PLAIN[number]
            found = probed(probe, bound)
            yield _record(number, name, "plain diffrax", bound, found)


def _record(number: int, name: str, engine: str, bound: Any, found: dict) -> dict:
    print(f"{number} {name}: {engine} {found['status']}", flush=True)
    fields = {"protocol": PROTOCOL, "problem": name, "solver": engine}
    return record(number=number, bound=bound, **fields, **found)
