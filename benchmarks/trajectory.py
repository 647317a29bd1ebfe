"""One trajectory: time against error, for the figures and random starts."""

from collections.abc import Callable, Iterator
from functools import partial

import diffrax
import numpy as np

from . import contestants as own, peers, problems, taylor
from .contestants import Contestant, cases
from .measure import WORST_ERROR, Case, Skipped, measure, skipped
from .problems import Problem, reference

PROTOCOL = "trajectory"
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-7, 1e-9, 1e-11, 1e-12)
LOOSE = (1e-3, 1e-5)

# Fixed steps are given as steps between output times, which are 1/100 of the whole.
Row = tuple[str, Callable[[Problem], Contestant], tuple]


def rows(problem: Problem) -> list[Row]:
    """Returns contestants and settings for one of the named problems."""
    plain = own.plain_textbook if problem.name == "fig5" else own.plain_reduced
    table: list[Row] = [
        ("fdof_jax", own.fdof_jax, TOLERANCES),
        *_solvers(TOLERANCES),
        ("plain diffrax", plain, TOLERANCES),
        *_general((1e-4, 1e-6, 1e-8, 1e-10, 1e-12), (10, 25, 50, 100, 250)),
        ("MuJoCo Euler", partial(peers.mujoco, integrator="Euler"), (10, 100, 1000)),
        (
            "MuJoCo implicitfast",
            partial(peers.mujoco, integrator="implicitfast"),
            (10, 100, 1000),
        ),
        ("heyoka", taylor.heyoka, (1e-4, 1e-7, 1e-10, 1e-12, 1e-15)),
        ("C RK4", partial(peers.native, method="RK4"), (10, 25, 50, 100, 250, 1000)),
        (
            "C order 8",
            partial(peers.native, method="order 8"),
            (1, 2, 3, 5, 10, 20, 40),
        ),
    ]
    if problem.name == "fig5":
        # Compilations of 10 s: shown once.
        stiff = partial(own.fdof_jax, solver=diffrax.Kvaerno5())
        table.append(("fdof_jax Kvaerno5", stiff, LOOSE))
        table.append(("MJX RK4", peers.mjx_rk4, (10, 25, 100)))
    return table


def _solvers(tolerances: tuple) -> list[Row]:
    return [
        (f"fdof_jax {type(s).__name__}", partial(own.fdof_jax, solver=s), tolerances)
        for s in (diffrax.Dopri8(), diffrax.Tsit5())
    ]


def _general(tolerances: tuple, steps: tuple) -> list[Row]:
    return [
        ("SciPy DOP853", partial(peers.scipy, method="DOP853"), tolerances),
        ("SciPy LSODA", partial(peers.scipy, method="LSODA"), tolerances),
        ("MuJoCo RK4", partial(peers.mujoco, integrator="RK4"), steps),
    ]


def random_rows() -> list[Row]:
    """Returns the contestants that take every topology, at fewer settings."""
    tolerances = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
    return [
        ("fdof_jax", own.fdof_jax, tolerances),
        *_solvers(tolerances),
        ("plain diffrax", own.plain_reduced, tolerances),
        *_general(tolerances[::2], (1, 4, 16)),
        ("MuJoCo Euler", partial(peers.mujoco, integrator="Euler"), (4, 40, 200)),
        ("heyoka", taylor.heyoka, (1e-4, 1e-9, 1e-15)),
    ]


def _settings(contestant: Contestant, problem: Problem, settings: tuple) -> tuple:
    if contestant.kind == "tolerance":
        return settings
    between = float(problem.ts[1] - problem.ts[0])
    return tuple(between / count for count in settings)


def _prepared(problem: Problem, exact: np.ndarray, table: list[Row]) -> Iterator[Case]:
    """Returns cases in the order of the table; None stands for a missing contestant."""
    for name, make, settings in table:
        try:
            contestant = make(problem)
        except Skipped as reason:
            yield name, str(reason)
            continue
        chosen = _settings(contestant, problem, settings)
        until = 21 if problem.name == "fig5" else None
        yield from cases(contestant, chosen, exact, problem, until)


def measure_one(
    problem: Problem, exact: np.ndarray, budget: float, table: list[Row]
) -> Iterator[dict]:
    prepared = []
    for case in _prepared(problem, exact, table):
        if isinstance(case, Case):
            prepared.append(case)
        else:
            name, reason = case
            yield {**skipped(PROTOCOL, name, reason), "problem": problem.name}
    yield from measure(
        PROTOCOL,
        prepared,
        budget=budget,
        ratio_to="fdof_jax",
        problem=problem.name,
        motions=1,
        simulated=float(problem.ts[-1]),
    )


def exact(problem: Problem) -> np.ndarray:
    """Returns the motion in extended precision, or in double without heyoka."""
    try:
        return taylor.extended(problem)
    except Skipped:
        return reference(problem)


def measure_fig5(budget: float) -> Iterator[dict]:
    """Measures Fig 5 twice from the same runs: errors up to 2 s, and to the end.

    The motion is chaotic: errors grow ten-thousandfold from 2 s to 10 s.
    """
    problem = problems.fig5()
    for point in measure_one(problem, exact(problem), budget, rows(problem)):
        yield {**point, "problem": "fig5-error-to-2s"}
        if point["times"]:
            late = {"error": point["error_end"], "problem": "fig5"}
            if not late["error"] <= WORST_ERROR:
                late.update(status="failed", times=None, time_median=None)
                late.update(reason=f"error {late['error']:.3g}")
            yield {**point, **late, "ratio": None, "ratio_quartiles": None}


def _together(parts: list[Case]) -> Case:
    """Returns a case that runs many problems in turn, judged by the worst."""

    def judge(results: list) -> dict:
        known = [part.judge(result) for part, result in zip(parts, results)]
        steps = [k["steps"] for k in known]
        return {
            "error": max(k["error"] for k in known),
            "steps": None if None in steps else float(np.mean(steps)),
        }

    first = parts[0]
    return first._replace(run=lambda: [part.run() for part in parts], judge=judge)


def measure_random(count: int, budget: float) -> Iterator[dict]:
    """Measures random arms of all topologies: total time at the worst error."""
    many = list(problems.random_singles(count))
    prepared = []
    for row in random_rows():
        columns = [list(_prepared(p, reference(p), [row])) for p in many]
        if isinstance(columns[0][0], Case):
            prepared += [_together(list(parts)) for parts in zip(*columns)]
        else:
            name, reason = columns[0][0]
            yield {**skipped(PROTOCOL, name, reason), "problem": "random"}
    yield from measure(
        PROTOCOL,
        prepared,
        budget=budget,
        ratio_to="fdof_jax",
        problem="random",
        motions=len(many),
        simulated=2.0 * len(many),
    )


def run(quick: bool) -> Iterator[dict]:
    budget = 5 if quick else 20
    yield from measure_fig5(budget)
    if not quick:
        for problem in (
            problems.swinging_rpr(),
            problems.fig7(),
            problems.weightless_rrp(),
        ):
            yield from measure_one(problem, reference(problem), 15, rows(problem))
    yield from measure_random(1 if quick else 3, budget)
