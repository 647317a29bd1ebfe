"""heyoka as a contestant: Taylor series of high order, compiled by LLVM.

It raises `Skipped` if it is not installed or cannot run the problem. Pendulums are in
absolute angles, with the linear solve written out, as its users would write them; of
the vector lengths and `fast_math`, the fastest on this machine is taken for each
tolerance; single arms take `fast_math`. `high_accuracy` made no difference to errors
here and cost a tenth of the time, and its ensembles cost more than a thread for each
core with an integrator each.
"""

import math
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np

import fdof_jax as fj

from .chain import Drive, make_rates
from .contestants import DT0, MAX_STEPS, Contestant, Motion
from .measure import Skipped
from .peers import module, one_free_arm, threads
from .pendulums import absolute, accelerations, constants, relative
from .problems import Problem

LANES = 4, 8  # lengths of vectors
ROUNDS = 20
TRIED = 64  # members on which they are compared


def symbolic(hy: Any, linkage: fj.Linkage, drive: Drive | None = None) -> list:
    """Returns the equations of any arm of three joints in heyoka's form."""
    variables = hy.make_vars("q1", "q2", "q3", "u1", "u2", "u3")

    def of(symbolic: Any, number: Any) -> Any:
        # Angles that no joint turns are plain numbers.
        return lambda x: symbolic(x) if isinstance(x, hy.expression) else number(x)

    rates = make_rates(linkage, of(hy.sin, math.sin), of(hy.cos, math.cos), drive)
    return list(zip(variables, rates(*variables)))


def pendulum(hy: Any, linkage: fj.Linkage) -> list:
    """Returns a pendulum in heyoka's form: absolute angles, then their rates."""
    arm = constants(linkage)
    angle = [hy.make_vars(f"a{k}") for k in range(len(arm.second))]
    rate = [hy.make_vars(f"w{k}") for k in range(len(arm.second))]
    found = accelerations(arm, angle, rate, hy.sin, hy.cos)
    return list(zip([*angle, *rate], [*rate, *found]))


def heyoka(problem: Problem, compact: bool = False) -> Contestant:
    """Returns an adaptive Taylor series, in vectors and threads for a batch.

    `compact`: compiled sooner, and slower.
    """
    one_free_arm(problem)
    hy, arm = module("heyoka"), constants(problem.linkage)
    system = pendulum(hy, problem.linkage)
    start = absolute(arm, *map(np.atleast_2d, problem.state0)).T
    begin, first, ts = problem.ts[0], problem.ts[0] + DT0, problem.ts[1:]
    workers = threads()

    def motion(states: np.ndarray) -> Motion:
        return Motion(*relative(arm, states))

    def settings(tolerance: float, **more: Any) -> dict:
        return dict(tol=tolerance, compact_mode=compact, **more)

    @cache
    def alone(tolerance: float) -> Any:
        return hy.taylor_adaptive(
            system, start[:, 0].copy(), **settings(tolerance, fast_math=True)
        )

    def run_alone(tolerance: float) -> np.ndarray:
        integrator = alone(tolerance)
        integrator.time = begin
        integrator.state[:] = start[:, 0]
        # From exact rest the estimate of the first step fails.
        integrator.propagate_until(first)
        return integrator.propagate_grid(np.concatenate([[first], ts]))[-1][1:]

    if problem.batch is None:
        return Contestant("heyoka", "tolerance", run_alone, motion)

    def blocks(integrator: Any, numbers: range, ends: np.ndarray) -> None:
        lanes = integrator.batch_size
        for number in numbers:
            members = slice(number * lanes, (number + 1) * lanes)
            integrator.set_time(begin)
            integrator.state[:] = start[:, members]
            integrator.propagate_until(ts[-1], max_steps=MAX_STEPS)
            ends[members, 0] = integrator.state.T

    def fastest(candidates: list) -> Any:
        ends = np.empty((start.shape[1], 1, len(start)))

        def time_of(integrator: Any) -> float:
            few = range(min(TRIED, start.shape[1]) // integrator.batch_size)
            began = time.perf_counter()
            blocks(integrator, few, ends)
            return time.perf_counter() - began

        # In turn, so that none is tried in a slow moment alone.
        times = [[*map(time_of, candidates)] for _ in range(ROUNDS)]
        return candidates[np.min(times, axis=0).argmin()]

    @cache
    def prepared(tolerance: float) -> list:
        candidates = [
            hy.taylor_adaptive_batch(
                system, start[:, :lanes].copy(), **settings(tolerance, fast_math=fast)
            )
            for lanes in LANES
            if start.shape[1] % lanes == 0
            for fast in ((False,) if compact else (False, True))
        ]
        if not candidates:
            raise Skipped(f"batches that {LANES[0]} does not divide")
        best = candidates[0] if compact else fastest(candidates)
        return [best, *(best.__deepcopy__({}) for _ in range(workers - 1))]

    def run(tolerance: float) -> np.ndarray:
        integrators = prepared(tolerance)
        ends = np.empty((start.shape[1], 1, len(start)))
        number = start.shape[1] // integrators[0].batch_size
        if workers == 1:
            blocks(integrators[0], range(number), ends)
        else:
            with ThreadPoolExecutor(workers) as pool:
                shares = [range(i, number, workers) for i in range(workers)]
                list(pool.map(blocks, integrators, shares, [ends] * workers))
        return ends

    return Contestant("heyoka", "tolerance", run, motion)
