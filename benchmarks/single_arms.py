"""Single arms: a plain call, gradients and a search, beside heyoka.

The times are those that a user waits once everything is compiled, with the installed
JAX. The job runs on the oldest and the newest JAX.
"""

from collections.abc import Callable, Iterator
from functools import partial

import diffrax
import jax
import numpy as np

import fdof_jax as fj
from fdof_jax.simulation.solve import solve

from . import contestants as own, gradients, problems, taylor, trajectory
from .contestants import Contestant
from .measure import Case, measure
from .problems import Problem

PROTOCOL = "single_arms"
TOLERANCES = (1e-5, 1e-7, 1e-9, 1e-11)


def plain_call(
    problem: Problem, solver: diffrax.AbstractSolver | None = None
) -> Contestant:
    """Returns `simulate`, called as at a prompt."""

    def run(tolerance: float):
        return fj.simulate(
            problem.linkage,
            problem.state0,
            problem.ts,
            problem.forces,
            solver=solver,
            rtol=tolerance,
            atol=tolerance,
        )

    name = "plain call" + ("" if solver is None else f", {type(solver).__name__}")
    return Contestant(f"fdof_jax, {name}", "tolerance", run, own._solution)


def _motion(budget: float) -> Iterator[dict]:
    problem = problems.fig5()
    exact = trajectory.exact(problem)
    rows: list = [
        ("", plain_call, TOLERANCES),
        ("", partial(plain_call, solver=diffrax.Dopri8()), TOLERANCES),
        ("", own.fdof_jax, TOLERANCES),
        ("heyoka", taylor.heyoka, (1e-7, 1e-10, 1e-12, 1e-15)),
    ]
    prepared = [c for c in trajectory._prepared(problem, exact, rows)]
    yield from measure(
        PROTOCOL,
        [c for c in prepared if isinstance(c, Case)],
        budget=budget,
        ratio_to="heyoka",
        problem="Fig 5, 10 s, error up to 2 s",
    )


def _gradients(budget: float) -> Iterator[dict]:
    for problem in gradients.PROBLEMS[:2]:
        runs = {mode: gradients.compiled(problem, mode) for mode in gradients.MODES}
        horizon, tolerance = gradients.HORIZON, gradients.TOLERANCE
        for point in gradients.measure_modes(
            problem, runs, 1, budget, horizon, tolerance, np.inf
        ):
            yield {
                **point,
                "protocol": PROTOCOL,
                "problem": f"Fig 7, 4 s, six {problem.name}",
            }


def _search(budget: float) -> Iterator[dict]:
    scene = fj.scenes.fig7()
    best = fj.tune(scene, starts=4).loss
    cases = [
        Case(
            "fdof_jax, tune",
            None,
            lambda: fj.tune(scene),
            lambda result: {"error": abs(result.loss - best) / best},
        )
    ]
    yield from measure(PROTOCOL, cases, budget=budget, problem="Fig 7, 10 s, tune")


def _door(budget: float) -> Iterator[dict]:
    """Measures a call of `simulate` over the compiled solve within it."""
    scene = fj.scenes.fig7()
    ts = np.array([0.0, 0.01])
    call = lambda: fj.simulate(scene.linkage, scene.state0, ts, scene.forces)
    inputs = scene.linkage, scene.state0, ts, None, scene.forces
    keywords = dict(
        solver=None,
        stepsize_controller=None,
        dt0=jax.numpy.asarray(1e-3),
        adjoint=diffrax.RecursiveCheckpointAdjoint(),
        max_steps=65536,
        progress_meter=diffrax.NoProgressMeter(),
    )
    alone: Callable = lambda: solve(inputs, keywords)[0]
    exact = np.asarray(call().q[-1])
    judge = lambda motion: {"error": float(np.abs(motion.q[-1] - exact).max())}
    yield from measure(
        PROTOCOL,
        [Case("fdof_jax, solve alone", None, alone, judge),
         Case("fdof_jax, plain call", None, call, judge)],
        budget=budget,
        ratio_to="fdof_jax, solve alone",
        equal_error=False,
        problem="Fig 7, 10 ms",
    )  # fmt: skip


def run(quick: bool) -> Iterator[dict]:
    budget = 2 if quick else 20
    yield from _motion(budget)
    yield from _door(budget)
    if not quick:
        yield from _gradients(budget)
        yield from _search(budget)
