"""Linear systems of the joints: a symmetric matrix in scalars."""

import functools
from collections.abc import Callable
from operator import add, or_, sub

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.one_loop import one_loop_on_cpu
from .equations import Constants, Equations, Scalars, Upper, where

Matrix = tuple[Scalars, ...]  # by columns

# These bits minus those of x are a first guess of 1/x, good to 12 %.
_RECIPROCAL_BITS = {
    np.dtype("float64"): np.int64(0x7FDE623822FC16E6),
    np.dtype("float32"): np.int32(0x7EF311C3),
}


def _iterated_reciprocal(x: Array) -> Array:
    """Computes 1/x to an ulp or two; XLA keeps real divisions out of fused loops."""
    bits = _RECIPROCAL_BITS[x.dtype]
    guess = bits - jax.lax.bitcast_convert_type(x, bits.dtype)
    y = jax.lax.bitcast_convert_type(guess, x.dtype)
    for _ in range(2):  # cubic: errors of 2e-3 and 5e-9 remain
        error = 1 - x * y
        y = y + y * (error + error * error)
    return y + y * (1 - x * y)


def divided(x: Array) -> Array:
    return 1 / x


@functools.cache
def fused(function: Callable) -> Callable:
    """Returns `function` with a reciprocal and a loop that suit the platform."""

    @jax.jit  # traced once, not at each use
    def on_platform(*arguments):
        return jax.lax.platform_dependent(
            *arguments,
            cpu=lambda *a: one_loop_on_cpu(function(_iterated_reciprocal, *a)),
            default=lambda *a: function(divided, *a),
        )

    return on_platform


def solver_of(
    c: Constants,
    m: Equations,
    added: Upper | None,
    reciprocal: Callable[[Array], Array],
) -> tuple[Callable[[Scalars], Scalars], Callable[[], Scalars]]:
    """Returns a function that solves M x = f, and one for the diagonal of M^-1.

    `m` includes `added`. The diagonal is infinite if M is not positive definite. Fixed
    pairs get zeros.
    """
    # The factorisation is L^T D L from the tip; its pivots are articulated inertias.
    joints = range(len(m.bias))
    rest = [list(row) for row in m.mass]  # entry (i, j) is rest[i][j - i]
    pivots, inverse = [], []
    factor: list[Scalars] = []  # row k: L_k0, ..., L_k,k-1
    for k in reversed(joints):
        pivot = rest[k][0]
        if added is None and k < joints[-1]:
            pivot = where(c.ends_in_slides[k], c.slide_pivot[k], pivot)
        pivot = where(c.fixed[k], jnp.ones_like(pivot), pivot)
        pivots.append(pivot)
        inverse.append(where(c.fixed[k], jnp.zeros_like(pivot), reciprocal(pivot)))
        column = [rest[i][k - i] for i in joints[:k]]
        factor.append(tuple(entry * inverse[-1] for entry in column))
        for i in joints[:k]:
            for j in joints[i:k]:
                rest[i][j - i] = rest[i][j - i] - factor[-1][i] * column[j]
    pivots, inverse, factor = pivots[::-1], inverse[::-1], factor[::-1]

    def solve(f: Scalars) -> Scalars:
        y, x = list(f), []
        for k in reversed(joints):
            for i in joints[:k]:
                y[i] = y[i] - factor[k][i] * y[k]
        for k in joints:
            shares = (factor[k][i] * x[i] for i in joints[:k])
            x.append(functools.reduce(sub, shares, y[k] * inverse[k]))
        return tuple(x)

    def inverse_diagonal() -> Scalars:
        # After a pivot that is not positive, the others may be NaN.
        singular = functools.reduce(or_, (pivot <= 0 for pivot in pivots))
        reduced: list[list[Array]] = []  # rows of L^-1 up to the diagonal
        diagonal = []
        for k in joints:
            row = [
                -functools.reduce(
                    add,
                    (factor[k][j] * reduced[j][i] for j in joints[i + 1 : k]),
                    factor[k][i],
                )
                for i in joints[:k]
            ]
            reduced.append(row)
            terms = (entry * entry * inverse[i] for i, entry in enumerate(row))
            own = functools.reduce(add, terms, inverse[k])
            diagonal.append(where(c.fixed[k], own, jnp.where(singular, jnp.inf, own)))
        return tuple(diagonal)

    return solve, inverse_diagonal


def minus(a: Scalars, b: Scalars) -> Scalars:
    return tuple(map(sub, a, b))


def with_added(added: Upper | None, m: Equations) -> Equations:
    if added is None:
        return m
    return Equations(jax.tree.map(add, m.mass, added), m.bias)


def times(m: Upper, x: Scalars) -> Scalars:
    joints = range(len(x))
    return tuple(
        functools.reduce(add, (m[min(i, j)][abs(i - j)] * x[j] for j in joints))
        for i in joints
    )
