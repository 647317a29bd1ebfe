"""Lock step: the cost of one unusual member of a batch to the others.

The batches are 256 random motions of Fig 5's arm: clean, with one member that spins and
so needs many times the steps, with one that is NaN at the start, and with one that
turns NaN mid-run.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import fdof_jax as fj

from .measure import Case, measure
from .problems import Problem, fig5_batch, reference

PROTOCOL = "lockstep"
TOLERANCE = 1e-8
SPIN = 70.0  # of the fast member's first joint [rad/s]: 33 times the steps
UNUSUAL = 100  # which member it is


class TurnsNaN(eqx.Module):
    """An effort of 0, and from 1 s on of `amplitude`, which is zero or NaN."""

    amplitude: Array

    def __call__(self, t, q, qd, linkage):
        return jnp.where(t > 1.0, self.amplitude, 0.0) * jnp.ones(3)


@jax.jit
def _vmapped(linkage, state0, ts, forces):
    def member(state0, forces):
        return fj.simulate(
            linkage, state0, ts, forces, rtol=TOLERANCE, atol=TOLERANCE, throw=False
        )

    return jax.vmap(member)(state0, forces)


def _swept(linkage, state0, ts, forces):
    return fj.sweep(
        linkage, state0, ts, forces, forces_axes=0, rtol=TOLERANCE, atol=TOLERANCE
    )


METHODS = {"fdof_jax": _vmapped, "fdof_jax sweep": _swept}


def _scenes(batch: int) -> Iterator[tuple[str, Problem, Array]]:
    problem = fig5_batch(batch)
    unusual = UNUSUAL % batch
    silent = jnp.zeros(batch)
    yield "clean", problem, silent
    q, qd = (np.array(a) for a in problem.state0)
    qd[unusual, 0] = SPIN
    yield "one fast", problem._replace(state0=fj.State(q, qd)), silent
    q = q.copy()
    q[unusual] = np.nan
    start = fj.State(q, np.zeros_like(q))
    yield "one NaN at the start", problem._replace(state0=start), silent
    yield "one NaN mid-run", problem, silent.at[unusual].set(jnp.nan)


def _judge(exact: np.ndarray, ignored: int | None, solution: Any) -> dict:
    """Returns the error of all members except the one that cannot have a result."""
    errors = np.abs(np.asarray(solution.q) - exact).max(axis=(1, 2))
    steps = np.asarray(solution.stats["num_steps"])
    if ignored is not None:
        errors = np.delete(errors, ignored)
    return {
        "error": float(errors.max()),
        "steps": float(steps.mean()),
        "steps_max": int(steps.max()),
        "waste": float(steps.max() / steps.mean()),
    }


def run(quick: bool) -> Iterator[dict]:
    batch = 32 if quick else 256
    prepared = {name: [] for name in METHODS}
    for scene, problem, amplitude in _scenes(batch):
        exact = reference(problem)
        ignored = UNUSUAL % batch if "NaN" in scene else None
        for name, method in METHODS.items():
            case = Case(
                f"{name}, {scene}",
                TOLERANCE,
                partial(
                    method,
                    problem.linkage,
                    jax.tree.map(jnp.asarray, problem.state0),
                    jnp.asarray(problem.ts),
                    (TurnsNaN(amplitude),),
                ),
                partial(_judge, exact, ignored),
                "tolerance",
                {"problem": scene},
            )
            prepared[name].append(case)
    # Ratios are over the clean batch of the same method; both methods interleaved
    # would share rounds only.
    for name, cases in prepared.items():
        yield from measure(
            PROTOCOL,
            cases,
            budget=5 if quick else 20,
            ratio_to=f"{name}, clean",
            equal_error=False,
            batch=batch,
        )
