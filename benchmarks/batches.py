"""Batches of arms: simulated seconds per wall second at the worst error."""

from collections.abc import Callable, Iterator
from functools import partial

import jax
import numpy as np

from . import contestants as own, one_core, peers, taylor
from .contestants import Contestant, cases
from .measure import Skipped, measure, record, skipped
from .native import Kernel
from .problems import Problem, fig5_batch, mixed_batch, reference

PROTOCOL = "batches"
SLOW = 1024  # the largest batch of slow peers
JUDGED = 16384  # members of a batch on an accelerator whose errors are known

TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
MJ_STEPS = (2e-2, 8e-3, 4e-3, 2e-3, 1e-3, 5e-4)
C_RK4_STEPS = (2e-2, 8e-3, 4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4)
C_8_STEPS = (5e-2, 4e-2, 2e-2, 1e-2, 5e-3)
HEYOKA_TOLERANCES = (1e-3, 1e-6, 1e-9, 1e-12, 1e-15)

Row = tuple[str, Callable[[Problem], Contestant], tuple]


def _fast(vmap: tuple, sweep: tuple, rk4: tuple, order8: tuple, heyoka: tuple):
    """Returns contestants for any size, each with its settings."""
    return [
        ("fdof_jax", own.fdof_jax, vmap),
        ("fdof_jax sweep", own.sweep, sweep),
        ("C RK4", partial(peers.native, method="RK4"), rk4),
        ("C order 8", partial(peers.native, method="order 8"), order8),
        ("heyoka", taylor.heyoka, heyoka),
    ]


def table(batch: int) -> list[Row]:
    """Returns contestants and settings for a batch size; large batches have fewer."""
    if batch > 16384:
        pair = (1e-7, 1e-10)
        return _fast(pair[:1], pair, (4e-3, 2e-3), (2e-2, 1e-2, 5e-3), (1e-6, 1e-9))
    if batch > SLOW:
        return _fast(
            TOLERANCES,
            TOLERANCES,
            (8e-3, 4e-3, 2e-3, 1e-3),
            C_8_STEPS,
            HEYOKA_TOLERANCES[:-1],
        )
    # Steps below that take minutes at 1024; MuJoCo's RK4 reaches 1e-6 with it.
    steps = MJ_STEPS if batch < SLOW else (8e-3, 4e-3, 2.5e-3)
    slow = [
        ("plain diffrax", own.plain_textbook, TOLERANCES),
        ("MuJoCo RK4", partial(peers.mujoco, integrator="RK4"), steps),
    ]
    if batch == SLOW:
        slow.append(("MJX RK4", peers.mjx_rk4, steps))
    every = TOLERANCES, TOLERANCES, C_RK4_STEPS, C_8_STEPS, HEYOKA_TOLERANCES
    return [*_fast(*every), *slow]


def measure_batch(
    problem: Problem, exact: np.ndarray, contestants: list, budget: float
) -> Iterator[dict]:
    """Returns all contestants' points on a batch; `exact` may be its first members."""
    prepared = []
    judged = len(exact)
    for name, make, settings in contestants:
        try:
            contestant = make(problem)
        except Skipped as reason:
            yield skipped(PROTOCOL, name, str(reason))
            continue
        motion = contestant.motion
        contestant = contestant._replace(
            motion=lambda r, motion=motion: first_members(motion(r), judged)
        )
        prepared += cases(contestant, settings, exact, problem)
    yield from measure(
        PROTOCOL,
        prepared,
        budget=budget,
        ratio_to="fdof_jax",
        problem=problem.name,
        batch=problem.batch,
        simulated=problem.batch * float(problem.ts[-1] - problem.ts[0]),
        judged=judged,
    )


def first_members(motion: own.Motion, count: int) -> own.Motion:
    return motion._replace(q=motion.q[:count])


def run(quick: bool) -> Iterator[dict]:
    """Measures all contestants at all sizes, on one core."""
    sizes = (
        {1: 10, 16: 10, 64: 20}
        if quick
        else {1: 10, 16: 10, 64: 20, 1024: 80, 16384: 30, 131072: 20}
    )
    for batch, budget in sizes.items():
        problem = fig5_batch(batch)
        yield from measure_batch(problem, _exact(problem), table(batch), budget)


def run_two_cores(quick: bool) -> Iterator[dict]:
    sizes = {64: 10} if quick else {1024: 25, 16384: 25}
    for batch, budget in sizes.items():
        problem = fig5_batch(batch)
        contestants = [row for row in table(batch) if not row[0].startswith("MJX")]
        contestants.append(("sweep on one core", one_core.sweep, TOLERANCES))
        yield from measure_batch(problem, reference(problem), contestants, budget)


def run_mixed(quick: bool) -> Iterator[dict]:
    """Measures random arms of all topologies, from random states."""
    tolerances = (1e-4, 1e-6, 1e-8, 1e-10)
    rows = [
        ("fdof_jax", own.fdof_jax, tolerances),
        ("fdof_jax sweep", own.sweep, tolerances),
        ("plain diffrax, reduced", own.plain_reduced, tolerances),
        ("plain diffrax, masked 6x6", own.plain_masked, tolerances[1::2]),
    ]
    problem = mixed_batch(64 if quick else 1024)
    budget = 5 if quick else 60
    for point in measure_batch(problem, reference(problem), rows, budget):
        yield {**point, "protocol": "mixed"}


def run_float32(quick: bool) -> Iterator[dict]:
    """Measures the library without x64, against the C kernel in float64."""
    for batch, budget in ({64: 10} if quick else {1024: 15, 16384: 20}).items():
        problem = fig5_batch(batch)
        problem = problem._replace(
            state0=jax.tree.map(np.float32, problem.state0), ts=np.float32(problem.ts)
        )
        try:
            exact = native_reference(problem)
        except Skipped as reason:
            yield skipped(PROTOCOL, "fdof_jax in float32", str(reason))
            return
        tolerances = (1e-3, 1e-4, 1e-5, 1e-6)
        rows = [(n, make, tolerances) for n, make, _ in table(batch)[:2]]
        yield from measure_batch(problem, exact, rows, budget)


def _exact(problem: Problem) -> np.ndarray:
    """Returns the reference; the library's own takes minutes for large batches."""
    if problem.batch > 16384:
        try:
            return native_reference(problem)
        except Skipped:
            pass
    return reference(problem)


def native_reference(problem: Problem) -> np.ndarray:
    """Returns joint positions at both ends, by C in steps of 2 ms, to about 1e-14."""
    q, qd = (np.float64(a) for a in problem.state0)
    kernel = Kernel("order 8", problem.linkage, q, qd)
    end, _ = kernel.joints(kernel(2e-3, 1000))
    return np.concatenate([q[:, None], end], axis=1)


def run_accelerator(quick: bool) -> Iterator[dict]:
    """Measures the library and plain diffrax on a GPU, until its memory is full."""
    if jax.devices()[0].platform == "cpu":
        yield skipped(PROTOCOL, "GPU", "JAX sees none")
        return
    batch = 1024
    while batch <= (1024 if quick else 2**26):
        problem = fig5_batch(batch)
        judged = problem._replace(
            state0=jax.tree.map(lambda a: a[:JUDGED], problem.state0)
        )
        exact = native_reference(judged)
        tolerances = (1e-5, 1e-7, 1e-9, 1e-11)
        if not jax.config.jax_enable_x64:
            tolerances = (1e-3, 1e-4, 1e-5, 1e-6)
        rows = [(n, make, tolerances) for n, make, _ in table(batch)[:2]]
        rows.append(("plain diffrax", own.plain_textbook, tolerances))
        points = list(measure_batch(problem, exact, rows, budget=20))
        yield from points
        if any("RESOURCE_EXHAUSTED" in (p["reason"] or "") for p in points):
            yield record(
                protocol=PROTOCOL,
                problem=problem.name,
                solver="GPU",
                batch=batch,
                status="failed",
                reason="the card's memory is full",
            )
            return
        batch *= 8
