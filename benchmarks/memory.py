"""Time and peak memory of a sweep as its members grow: motions, ends only, a store."""

import itertools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

import fdof_jax as fj

from .many import peak
from .measure import record
from .problems import fig5_batch
from .tables import number, table

PROTOCOL = "memory"
TOLERANCE = 1e-6
TS = np.linspace(0.0, 2.0, 51)
BLOCK = 8192  # members that compile what more members need


def end(scene: fj.Scene, motion: fj.Solution) -> jax.Array:
    return motion.q[-1]


def whole(problem: Any, **options: Any) -> Any:
    arguments = problem.linkage, problem.state0, TS
    return fj.sweep(*arguments, rtol=TOLERANCE, atol=TOLERANCE, **options)


def stored(problem: Any) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        return whole(problem, store=folder)


KINDS: dict[str, Callable] = {
    "motions": whole,
    "ends only": lambda problem: whole(problem, reduce=end),
    "motions in a store": stored,
}


def one(kind: str, members: int) -> dict:
    """Measures one sweep in this process."""
    problem = fig5_batch(members)
    few = jax.tree.map(lambda leaf: leaf[:BLOCK], problem.state0)
    began = time.perf_counter()
    jax.block_until_ready(KINDS[kind](problem._replace(state0=few)))
    compiled, before = time.perf_counter() - began, peak()
    began = time.perf_counter()
    jax.block_until_ready(KINDS[kind](problem))
    wall = time.perf_counter() - began
    return {
        "problem": problem.name,
        "batch": members,
        "compile_time": compiled,
        "time_median": wall,
        "times": [wall],
        "memory_before_mb": before,
        "memory_peak_mb": peak(),
    }


def run(quick: bool) -> Iterator[dict]:
    """Measures each sweep in a process of its own, which has a peak of its own."""
    sizes = (1000, 4000) if quick else (10**3, 10**4, 10**5, 10**6)
    for kind, size in itertools.product(KINDS, sizes):
        command = [sys.executable, "-m", "benchmarks.memory", kind, str(size)]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
        setting = {"protocol": PROTOCOL, "solver": kind, "setting": TOLERANCE}
        if done.returncode:
            reason = f"ended with {done.returncode}"
            yield record(**setting, batch=size, status="failed", reason=reason)
        else:
            yield record(**setting, **json.loads(done.stdout))


def memory_table(points: list[dict]) -> str:
    columns = ("time_median", "memory_before_mb", "memory_peak_mb")
    rows = [
        [number(p["batch"]), p["solver"], *(number(p.get(key), 3) for key in columns)]
        for p in points
    ]
    return table(["members", "", "s", "memory before [MB]", "at most [MB]"], rows)


if __name__ == "__main__":
    fj.configure(x64=True)
    print(json.dumps(one(sys.argv[1], int(sys.argv[2]))))
