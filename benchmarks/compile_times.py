"""Compile times: cold, and with JAX's persistent compilation cache warm.

Every sample is a process of its own, which fills a fresh cache folder or reads a full
one. A first call less a second one is what counts; imports are apart. JAX keeps nothing
that calls back to Python, which checks that raise do: EQX_ON_ERROR=nan does without.

    python -m benchmarks.compile_times CASE    (one sample: prints seconds)
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .measure import FEWEST, record
from .problems import fig5, fig5_batch
from .worker import XLA_FLAGS

PROTOCOL = "compile_times"
SAMPLES = 3


def simulate() -> Callable:
    problem = fig5()
    return lambda: fj.simulate(problem.linkage, problem.state0, problem.ts)


def sweep() -> Callable:
    problem = fig5_batch(256)
    return lambda: fj.sweep(problem.linkage, problem.state0, problem.ts)


def _gradient(mode: str) -> Callable:
    from . import gradients

    problem = gradients.PROBLEMS[0]
    run = gradients.compiled(problem, mode)
    p = gradients.parameters(problem, 1)
    return lambda: run(p, gradients.HORIZON, gradients.TOLERANCE)


def gradient_forward() -> Callable:
    return _gradient("forward")


def gradient_reverse() -> Callable:
    return _gradient("reverse")


def simulate_dopri8() -> Callable:
    problem = fig5()
    solver = diffrax.Dopri8()
    return lambda: fj.simulate(
        problem.linkage, problem.state0, problem.ts, solver=solver
    )


# The environment of a case follows its name.
ENVIRONMENTS = {
    "EQX_ON_ERROR=nan": {"EQX_ON_ERROR": "nan"},
    "XLA_FLAGS": {"XLA_FLAGS": XLA_FLAGS},
}
CASES = {
    "simulate": simulate,
    "simulate, EQX_ON_ERROR=nan": simulate,
    "simulate, XLA_FLAGS": simulate,
    "simulate by diffrax.Dopri8": simulate_dopri8,
    "sweep of 256": sweep,
    "value and gradient, forward": gradient_forward,
    "value and gradient, forward, XLA_FLAGS": gradient_forward,
    "value and gradient, reverse": gradient_reverse,
}
# What the cache is tried with, and without the check that keeps a program out of it.
CACHED = "simulate", "simulate, EQX_ON_ERROR=nan", "sweep of 256"


def _sample(name: str) -> float:
    """In a process of its own: the first call less the second [s]."""
    jnp.sin(jnp.ones(3)).block_until_ready()  # starts JAX
    run = CASES[name]()
    times = []
    for _ in range(2):
        began = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - began)
    return times[0] - times[1]


def _ask(name: str, folder: str) -> float:
    output = subprocess.run(
        [sys.executable, "-m", "benchmarks.compile_times", name],
        env={
            **os.environ,
            "JAX_ENABLE_X64": "1",
            **ENVIRONMENTS.get(name.rsplit(", ", 1)[-1], {}),
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        },
        capture_output=True,
        text=True,
        check=False,
    )
    if output.returncode:
        raise RuntimeError(output.stderr.strip().splitlines()[-1])
    return json.loads(output.stdout.splitlines()[-1])


def run(quick: bool) -> Iterator[dict]:
    samples = 1 if quick else max(SAMPLES, FEWEST)
    for name in list(CASES)[:1] if quick else CASES:
        cold, warm, failure = [], [], None
        try:
            for _ in range(samples):
                with tempfile.TemporaryDirectory() as folder:
                    cold.append(_ask(name, folder))
                    if len(cold) == samples and name in CACHED:
                        warm.append(_ask(name, folder))
        except RuntimeError as error:
            failure = str(error)[:200]
        for cache, times in (("cold", cold), ("warm", warm)):
            if cache == "warm" and name not in CACHED:
                continue
            fields = {"status": "failed", "reason": failure}
            if failure is None:
                low, median, high = np.percentile(times, [25, 50, 75])
                fields = {
                    "times": times,
                    "time_min": min(times),
                    "time_median": median,
                    "time_quartiles": [low, high],
                    "compile_time": median,
                }
            yield record(
                protocol=PROTOCOL,
                problem=name,
                solver=f"fdof_jax, {cache} cache",
                **fields,
            )


if __name__ == "__main__":
    print(json.dumps(_sample(sys.argv[1])))
