"""Solves one arm from concrete inputs, as at a prompt, with few programs."""

import diffrax
import equinox as eqx
import jax
import numpy as np
from jax import Array

from ..checks import is_traced
from .integrate import integrate
from .solution import Solution

# All calls with at most this many output times share one program.
_FEWEST_TIMES = 512


def solve_one(inputs, keywords) -> tuple[Solution, bool] | None:
    """Computes the motion of one arm from concrete inputs, and whether it succeeded.

    Output times are padded with the last one to a power of two, so that few programs
    serve all numbers of them. Returns None if a force element holds a traced value.
    """
    linkage, state0, ts, own0, forces = inputs
    times = np.asarray(ts)
    count = len(times)
    size = max(_FEWEST_TIMES, 1 << (count - 1).bit_length())
    filled = np.pad(times, (0, size - count), mode="edge")
    padded = linkage, state0, filled, own0, forces
    solution, succeeded = _solve_padded(padded, keywords)
    if is_traced(solution):
        return None

    def cut(rows: Array) -> Array:
        # JAX slices and jnp.asarray would compile a program for each new shape.
        return jax.device_put(np.asarray(rows)[:count])

    q, qd, own = cut(solution.q), cut(solution.qd), jax.tree.map(cut, solution.own)
    whole = Solution(ts, q, qd, solution.stats, solution.result, own)
    return whole, bool(succeeded)


@eqx.filter_jit
def _solve_padded(inputs, keywords) -> tuple[Solution, Array]:
    # The steps are those of the same call with forward-mode derivatives.
    derivatives = isinstance(keywords["adjoint"], diffrax.ForwardMode)
    keywords = keywords | {"adjoint": diffrax.ForwardMode()}
    solution = integrate(inputs, keywords, derivatives, padded=True)
    return solution, solution.result == diffrax.RESULTS.successful
