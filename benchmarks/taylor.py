"""heyoka as a contestant: Taylor series of high order, compiled by LLVM.

It raises `Skipped` if it is not installed or cannot run the problem.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np

import fdof_jax as fj

from .chain import Drive, make_rates
from .contestants import DT0, MAX_STEPS, Contestant, Motion
from .measure import Skipped
from .peers import module, one_free_arm, threads
from .problems import Problem


def symbolic(hy: Any, linkage: fj.Linkage, drive: Drive | None = None) -> list:
    """Returns the equations in heyoka's form."""
    variables = hy.make_vars("q1", "q2", "q3", "u1", "u2", "u3")

    def of(symbolic: Any, number: Any) -> Any:
        # Angles that no joint turns are plain numbers.
        return lambda x: symbolic(x) if isinstance(x, hy.expression) else number(x)

    rates = make_rates(linkage, of(hy.sin, math.sin), of(hy.cos, math.cos), drive)
    return list(zip(variables, rates(*variables)))


def extended(problem: Problem) -> np.ndarray:
    """Returns positions at the output times by heyoka in 80-bit numbers."""
    one_free_arm(problem)
    hy = module("heyoka")
    wide = np.longdouble
    if np.finfo(wide).nmant < 63:
        raise Skipped("no 80-bit numbers here")
    start = np.concatenate([problem.state0.q, problem.state0.qd]).astype(wide)
    integrator = hy.taylor_adaptive(
        symbolic(hy, problem.linkage), start, fp_type=wide, tol=wide(1e-19)
    )
    ts = problem.ts.astype(wide)
    integrator.propagate_until(ts[0] + wide(DT0))
    grid = np.concatenate([[integrator.time], ts[1:]])
    states = integrator.propagate_grid(grid)[-1]
    states[0] = start
    return states[:, :3].astype(float)


def heyoka(
    problem: Problem, equations: Callable = symbolic, compact: bool = False
) -> Contestant:
    """Returns an adaptive Taylor series compiled by LLVM; batches in vectors.

    `compact`: compiled sooner, and slower.
    """
    one_free_arm(problem)
    hy = module("heyoka")
    system = equations(hy, problem.linkage)
    q, qd = (np.atleast_2d(a) for a in problem.state0)
    start = np.concatenate([q, qd], axis=1).T
    begin, first, ts = problem.ts[0], problem.ts[0] + DT0, problem.ts[1:]
    single = problem.batch is None
    lanes = 1 if single else min(8, start.shape[1])
    if start.shape[1] % lanes:
        raise Skipped(f"batches that {lanes} does not divide")
    workers = threads()

    @cache
    def prepared(tolerance: float) -> list:
        if single:
            begun = start[:, 0].copy()
            return [
                hy.taylor_adaptive(system, begun, tol=tolerance, compact_mode=compact)
            ]
        block = start[:, :lanes].copy()
        one = hy.taylor_adaptive_batch(
            system, block, tol=tolerance, compact_mode=compact
        )
        return [one, *(one.__deepcopy__({}) for _ in range(workers - 1))]

    def run_single(tolerance: float) -> np.ndarray:
        (integrator,) = prepared(tolerance)
        integrator.time = begin
        integrator.state[:] = start[:, 0]
        # From exact rest the estimate of the first step fails.
        integrator.propagate_until(first)
        grid = np.concatenate([[first], ts])
        return integrator.propagate_grid(grid)[-1][1:]

    def blocks(integrator: Any, numbers: range, ends: np.ndarray) -> None:
        for number in numbers:
            members = slice(number * lanes, (number + 1) * lanes)
            integrator.set_time(begin)
            integrator.state[:] = start[:, members]
            integrator.propagate_until(ts[-1], max_steps=MAX_STEPS)
            ends[members, 0] = integrator.state.T

    def run_batch(tolerance: float) -> np.ndarray:
        ends = np.empty((start.shape[1], 1, len(start)))
        integrators = prepared(tolerance)
        number = start.shape[1] // lanes
        if workers == 1:
            blocks(integrators[0], range(number), ends)
        else:
            with ThreadPoolExecutor(workers) as pool:
                shares = [range(i, number, workers) for i in range(workers)]
                list(pool.map(blocks, integrators, shares, [ends] * workers))
        return ends

    return Contestant(
        "heyoka",
        "tolerance",
        run_single if single else run_batch,
        lambda states: Motion(*np.split(states, 2, axis=-1)),
    )
