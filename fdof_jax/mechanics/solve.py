"""Linear systems of the joints: a symmetric matrix of 3 x 3 in scalars."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..xla.one_loop import one_loop_on_cpu
from .equations import (
    Constants,
    Equations,
    Scalars,
)

Matrix = tuple[Scalars, Scalars, Scalars]  # by columns
# The force elements' share of the mass matrix: m11, m12, m13, m22, m23, m33.
Added = tuple[Array, Array, Array, Array, Array, Array]

# These bits minus those of x are a first guess of 1/x, good to 12 %; then the number of
# Newton iterations.
_RECIPROCAL_BITS = {
    np.dtype("float64"): (np.int64(0x7FDE623822FC16E6), 5),
    np.dtype("float32"): (np.int32(0x7EF311C3), 4),
}


def _newton_reciprocal(x: Array) -> Array:
    """Computes 1/x to an ulp or two; XLA keeps real divisions out of fused loops."""
    bits, iterations = _RECIPROCAL_BITS[x.dtype]
    guess = bits - jax.lax.bitcast_convert_type(x, bits.dtype)
    y = jax.lax.bitcast_convert_type(guess, x.dtype)
    for _ in range(iterations):
        y = y + y * (1 - x * y)
    return y


def divided(x: Array) -> Array:
    return 1 / x


@functools.cache
def fused(function: Callable) -> Callable:
    """Returns `function` with a reciprocal and a loop that suit the platform."""

    @jax.jit  # traced once, not at each use
    def on_platform(*arguments):
        return jax.lax.platform_dependent(
            *arguments,
            cpu=lambda *a: one_loop_on_cpu(function(_newton_reciprocal, *a)),
            default=lambda *a: function(divided, *a),
        )

    return on_platform


def solver_of(
    c: Constants,
    m: Equations,
    added: Added | None,
    reciprocal: Callable[[Array], Array],
) -> tuple[Callable[[Scalars], Scalars], Callable[[], Scalars]]:
    """Returns a function that solves M x = f, and one for the diagonal of M^-1.

    The factorisation is L^T D L from the tip, whose pivots are articulated inertias.
    `m` already includes `added`. The diagonal is infinite if a pivot is not positive.
    """
    inverse3 = reciprocal(m.m33)
    l23, l13 = m.m23 * inverse3, m.m13 * inverse3
    pivot2 = m.m22 - l23 * m.m23
    if added is None:
        pivot2 = jnp.where(c.slide_on_slide, c.slide2, pivot2)
    inverse2 = reciprocal(pivot2)
    rest12 = m.m12 - l13 * m.m23
    l12 = rest12 * inverse2
    pivot1 = m.m11 - l13 * m.m13 - l12 * rest12
    inverse1 = reciprocal(pivot1)

    def solve(f: Scalars) -> Scalars:
        y2 = f[1] - l23 * f[2]
        x1 = (f[0] - l13 * f[2] - l12 * y2) * inverse1
        x2 = y2 * inverse2 - l12 * x1
        return x1, x2, f[2] * inverse3 - l13 * x1 - l23 * x2

    def inverse_diagonal() -> Scalars:
        from1 = l13 - l12 * l23
        second = inverse2 + l12 * l12 * inverse1
        third = inverse3 + l23 * l23 * inverse2 + from1 * from1 * inverse1
        # After a pivot that is not positive, the others may be NaN.
        singular = (m.m33 <= 0) | (pivot2 <= 0) | (pivot1 <= 0)
        first, second, third = (
            jnp.where(singular, jnp.inf, i) for i in (inverse1, second, third)
        )
        return first, second, third

    return solve, inverse_diagonal


def minus(a: Scalars, b: Scalars) -> Scalars:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def with_added(added: Added | None, m: Equations) -> Equations:
    if added is None:
        return m
    m11, m12, m13, m22, m23, m33 = added
    return Equations(
        m.m11 + m11, m.m12 + m12, m.m13 + m13, m.m22 + m22, m.m23 + m23, m.m33 + m33,
        m.bias,
    )  # fmt: skip


def times(m: Added, x: Scalars) -> Scalars:
    m11, m12, m13, m22, m23, m33 = m
    return (
        m11 * x[0] + m12 * x[1] + m13 * x[2],
        m12 * x[0] + m22 * x[1] + m23 * x[2],
        m13 * x[0] + m23 * x[1] + m33 * x[2],
    )
