"""Single arms: motions called as at a prompt and within `jax.jit`, beside heyoka."""

from collections.abc import Callable, Iterator

import jax
import numpy as np

import fdof_jax as fj

from . import contestants as own, peers, problems, taylor
from .contestants import cases
from .measure import Case, Skipped, measure, skipped

TOLERANCES = (1e-5, 1e-7, 1e-9, 1e-11)


def run(quick: bool) -> Iterator[dict]:
    budget = 2 if quick else 20
    problem = problems.fig5()
    exact = problems.reference(problem)
    rows: list[tuple[Callable, tuple]] = [
        (own.plain_call, TOLERANCES),
        (own.fdof_jax, TOLERANCES),
        (own.diffrax_scalars, TOLERANCES),
        (own.diffrax_textbook, TOLERANCES),
        (taylor.heyoka, (1e-3, 1e-5, 1e-7, 1e-9, 1e-12)),
        (peers.mujoco, (1e-2, 5e-3, 1e-3, 2.5e-4)),
    ]
    prepared = []
    for make, settings in rows:
        try:
            prepared += cases(make(problem), settings, exact)
        except Skipped as reason:
            yield skipped("single_arms", make.__name__, str(reason))
    yield from measure(
        "single_arms", prepared, budget=budget,
        problem="Fig 5, 2 s", simulated=2.0,
    )  # fmt: skip
    # A motion so short that what counts is the way to the compiled solve.
    scene = fj.scenes.fig7()
    ts = np.array([0.0, 0.01])
    call = lambda: fj.simulate(scene, ts)
    within = jax.jit(lambda scene: fj.simulate(scene, ts))
    last = np.asarray(call().q[-1])
    judge = lambda motion: {"error": float(np.abs(motion.q[-1] - last).max())}
    yield from measure(
        "single_arms",
        [Case("fdof_jax, plain call", None, call, judge),
         Case("fdof_jax", None, lambda: within(scene), judge)],
        budget=budget / 2, problem="Fig 7, 10 ms",
    )  # fmt: skip
