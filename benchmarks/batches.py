"""Batches of arms: simulated seconds per wall second at the worst member's error."""

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import jax
import numpy as np

from . import contestants as own, peers, taylor
from .contestants import Contestant, Motion, cases
from .measure import Skipped, measure, record, skipped
from .native import Kernel
from .problems import Problem, fig5_batch, mixed_batch, reference

SLOW = 1024  # the largest batch of slow peers
JUDGED = 16384  # members of a batch on an accelerator whose errors are known
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
FEW = TOLERANCES[1:]
STEPS = (8e-3, 4e-3, 2.5e-3, 4e-4)  # of MuJoCo, whose RK4 reaches 1e-9 with the last
SINGLE = (1e-3, 1e-4, 1e-5, 1e-6)  # tolerances in float32

Row = tuple[str, Callable[[Problem], Contestant], tuple]


def contestants(batch: int) -> list[Row]:
    """Returns contestants and settings for a size; large batches have fewer."""
    c = lambda method: partial(peers.native, method=method)
    rows: list[Row] = [
        ("fdof_jax sweep", own.sweep, FEW),
        ("fdof_jax", own.fdof_jax, FEW),
        ("heyoka", taylor.heyoka, (1e-5, 1e-7, 1e-9, 1e-11)),
        ("C order 8", c("order 8"), (4e-2, 2e-2, 1e-2, 5e-3)),
        ("C RK4", c("RK4"), (4e-3, 2e-3, 1e-3, 5e-4)),
    ]
    if batch <= SLOW:
        rows += [
            ("diffrax, scalars", own.diffrax_scalars, FEW),
            ("diffrax, arrays", own.diffrax_textbook, FEW),
            ("MuJoCo RK4", peers.mujoco, STEPS),
        ]
    return rows


def measured(
    protocol: str, problem: Problem, exact: np.ndarray, rows: list, budget: float
) -> Iterator[dict]:
    """Returns all contestants' points on a batch; `exact` may be its first members."""
    prepared = []
    for name, make, settings in rows:
        try:
            prepared += cases(make(problem), settings, exact)
        except Skipped as reason:
            yield skipped(protocol, name, str(reason))
    yield from measure(
        protocol,
        prepared,
        budget=budget,
        problem=problem.name,
        batch=problem.batch,
        simulated=problem.batch * float(problem.ts[-1] - problem.ts[0]),
    )


def run(quick: bool) -> Iterator[dict]:
    """Measures all contestants at all sizes, then arms of all kinds, on one core."""
    sizes = {16: 3, 128: 6, 1024: 30, 16384: 15}
    for batch, budget in {16: 2, 128: 4}.items() if quick else sizes.items():
        problem = fig5_batch(batch)
        rows = contestants(batch)
        yield from measured("batches", problem, exactly(problem), rows, budget)
    case = own.equations_alone(fig5_batch(256))
    yield from measure("batches", [case], budget=2, problem="equations alone")
    problem = mixed_batch(64 if quick else 1024)
    rows = [
        ("fdof_jax sweep", own.sweep, FEW),
        ("fdof_jax", own.fdof_jax, FEW),
        ("diffrax, our equations", own.diffrax_reduced, FEW),
    ]
    yield from measured("batches", problem, reference(problem), rows, 15)


def run_two_cores(quick: bool) -> Iterator[dict]:
    """Measures on two cores, beside one core alone, and with the second one busy."""
    for batch, budget in ({128: 4} if quick else {1024: 15, 16384: 20}).items():
        problem = fig5_batch(batch)
        rows = [
            row for row in contestants(batch) if row[0] in ("fdof_jax sweep", "heyoka")
        ]
        rows.append(("one core", partial(pinned, cores=1), FEW))
        exact = exactly(problem)
        both: Row = "a process a core", partial(pinned, cores=2), FEW
        yield from measured("cores", problem, exact, [*rows, both], budget)
        with _busy_core():
            for point in measured("cores", problem, exact, rows, budget / 2):
                yield {**point, "problem": "the second core busy"}


def run_accelerator(quick: bool) -> Iterator[dict]:
    """Measures the library and diffrax on a GPU, until its memory is full."""
    if jax.devices()[0].platform == "cpu":
        yield skipped("gpu", "GPU", "JAX sees none")
        return
    tolerances = FEW if jax.config.jax_enable_x64 else SINGLE
    batch = 1024
    while batch <= (1024 if quick else 2**26):
        problem = fig5_batch(batch)
        judged = problem._replace(
            state0=jax.tree.map(lambda a: a[:JUDGED], problem.state0)
        )
        rows = [("fdof_jax sweep", own.sweep, tolerances)]
        rows += [("fdof_jax", own.fdof_jax, tolerances)]
        rows += [("diffrax, scalars", own.diffrax_scalars, tolerances)]
        points = list(measured("gpu", problem, exactly(judged), rows, 20))
        yield from points
        if any("RESOURCE_EXHAUSTED" in (p["reason"] or "") for p in points):
            reason = "the card's memory is full"
            yield record(protocol="gpu", solver="GPU", batch=batch, status="failed",
                         problem=problem.name, reason=reason)  # fmt: skip
            return
        batch *= 8


def exactly(problem: Problem) -> np.ndarray:
    """Returns joint positions at both ends, by C in steps of 2 ms, to about 1e-14."""
    q, qd = (np.float64(a) for a in problem.state0)
    try:
        kernel = Kernel("order 8", problem.linkage, q, qd)
    except Skipped:
        return reference(problem)
    end, _ = kernel.joints(kernel(2e-3, 1000))
    return np.concatenate([q[:, None], end], axis=1)


# JAX has threads for the cores that it finds when it starts, so that one core alone
# takes a process of its own.


def _serve(pipe: Connection, core: int, batch: int, members: slice) -> None:
    """Runs a sweep for each tolerance received, and sends its motion if asked."""
    os.sched_setaffinity(0, {core})
    import fdof_jax as fj

    fj.configure(x64=True)
    problem = fig5_batch(batch)
    state0 = jax.tree.map(lambda rows: rows[members], problem.state0)
    contestant, result = own.sweep(problem._replace(state0=state0)), None
    while True:
        try:
            tolerance = pipe.recv()
        except EOFError:  # the benchmark is done
            return
        if tolerance is None:
            pipe.send(tuple(map(np.asarray, contestant.motion(result))))
        else:
            result = contestant.run(tolerance)
            pipe.send(None)


def pinned(problem: Problem, cores: int) -> Contestant:
    """Returns `sweep` of Fig 5's batch, in a process for each of the first cores."""
    processes, pipes = multiprocessing.get_context("spawn"), []
    for share, core in enumerate(sorted(os.sched_getaffinity(0))[:cores]):
        pipe, other = processes.Pipe()
        members = slice(share, None, cores)  # which take equally long
        arguments = other, core, problem.batch, members
        processes.Process(target=_serve, args=arguments, daemon=True).start()
        other.close()  # so that a dead process ends `recv`
        pipes.append(pipe)

    def ask(tolerance: float | None) -> list:
        for pipe in pipes:
            pipe.send(tolerance)
        return [pipe.recv() for pipe in pipes]

    def motion(_: Any) -> Motion:
        parts = zip(*ask(None))
        joined = lambda part: np.stack(part, 1).reshape(-1, *part[0].shape[1:])
        return Motion(*map(joined, parts))

    name = "one core" if cores == 1 else "a process a core"
    return Contestant(name, "tolerance", ask, motion)


def _spin(core: int) -> None:
    os.sched_setaffinity(0, {core})
    while True:
        pass


@contextlib.contextmanager
def _busy_core() -> Iterator[None]:
    """Keeps the last core busy while it lasts."""
    start = multiprocessing.get_context("spawn").Process
    last = max(os.sched_getaffinity(0))
    process = start(target=_spin, args=(last,), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.terminate()
