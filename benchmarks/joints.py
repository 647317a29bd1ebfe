"""The number of joints: cost of hanging chains of one to eight equal rods."""

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

import fdof_jax as fj
from fdof_jax.mechanics.equations import link_constants, zeros
from fdof_jax.mechanics.rates import rates

from . import contestants as own, peers, taylor
from .contestants import cases
from .measure import Skipped, measure, skipped
from .problems import Problem, chain, reference

BATCH = 1024
MEMBERS = 16  # of a batch for MuJoCo, which runs them in turn
TOLERANCES, HEYOKA = (1e-7, 1e-9), (1e-3, 1e-5, 1e-7, 1e-9)
STEPS = 2e-2, 8e-3, 2e-3, 4e-4


def flops(linkage: fj.Linkage) -> float:
    """Returns the operations of one evaluation of the equations, as lowered."""
    q = linkage.locked
    arguments = link_constants(linkage, q), zeros(q), tuple(q), zeros(q)
    return jax.jit(rates).lower(*arguments).cost_analysis()["flops"]


def _exact(problem: Problem) -> np.ndarray:
    """Returns joint positions at both ends, to about 1e-13."""
    try:
        heyoka = taylor.heyoka(problem, compact=True)
    except Skipped:
        return reference(problem)
    end = heyoka.motion(heyoka.run(1e-15)).q
    return np.concatenate([np.asarray(problem.state0.q)[:, None], end], axis=1)


def _members(problem: Problem, which: Any) -> Problem:
    """Returns some members of a batch; a single one for an index."""
    return problem._replace(state0=jax.tree.map(lambda a: a[which], problem.state0))


def run(quick: bool) -> Iterator[dict]:
    most = 16 if quick else BATCH
    for joints in (2,) if quick else (1, 2, 3, 4, 6, 8):
        problem = chain(joints, most)
        exact, seconds = _exact(problem), float(problem.ts[-1])
        for batch in (1, most):
            first: Any = own.fdof_jax if batch == 1 else own.sweep
            rows = [
                (first, TOLERANCES, batch),
                (taylor.heyoka, HEYOKA, batch),
                (peers.mujoco, STEPS, min(batch, MEMBERS)),
            ]
            prepared = []
            for make, settings, count in rows:
                which: Any = 0 if batch == 1 else slice(count)
                part = _members(problem, which)
                try:
                    contestant = make(part)
                except Skipped as reason:
                    yield skipped("joints", make.__name__, str(reason))
                    continue
                fields = {"simulated": count * seconds}
                found = cases(contestant, settings, exact[which])
                prepared += [case._replace(fields=fields) for case in found]
            yield from measure(
                "joints", prepared, budget=0.5 if quick else 3,
                problem=problem.name, batch=batch, joints=joints,
                flops=flops(problem.linkage),
            )  # fmt: skip
