"""What integrators take: the rates of a linkage's state, and their derivatives.

XLA on CPU gives each result of an expression, and each division in it, a loop of its
own over the batch: five evaluations of the equations for one. Here they are one fused
loop, in forward and in derivative computations.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from ..xla.one_loop import one_loop_on_cpu
from .equations import (
    Constants,
    Directions,
    Equations,
    Scalars,
    directions,
    equations,
    turns,
)

Matrix = tuple[Scalars, Scalars, Scalars]  # by columns
# What force elements add to the mass matrix: m11, m12, m13, m22, m23, m33.
Added = tuple[Array, Array, Array, Array, Array, Array]

# A first guess of 1/x, good to 12 %: these bits less those of x.
_RECIPROCAL_BITS = {
    np.dtype("float64"): (np.int64(0x7FDE623822FC16E6), 5),
    np.dtype("float32"): (np.int32(0x7EF311C3), 4),
}


def _newton_reciprocal(x: Array) -> Array:
    """1/x to an ulp or two, without a division, which XLA keeps out of fused loops."""
    bits, iterations = _RECIPROCAL_BITS[x.dtype]
    guess = bits - jax.lax.bitcast_convert_type(x, bits.dtype)
    y = jax.lax.bitcast_convert_type(guess, x.dtype)
    for _ in range(iterations):
        y = y + y * (1 - x * y)
    return y


def _divided(x: Array) -> Array:
    return 1 / x


@functools.cache
def _one_loop(function: Callable) -> Callable:
    """`function(reciprocal, *arguments)` by the means of the platform."""

    @jax.jit  # traced once, not at each use
    def on_platform(*arguments):
        return jax.lax.platform_dependent(
            *arguments,
            cpu=lambda *a: one_loop_on_cpu(function(_newton_reciprocal, *a)),
            default=lambda *a: function(_divided, *a),
        )

    return on_platform


def _solver(
    c: Constants,
    m: Equations,
    added: Added | None,
    reciprocal: Callable[[Array], Array],
) -> tuple[Callable[[Scalars], Scalars], Callable[[], Scalars]]:
    """Solves M x = f, by L^T D L from the tip: the pivots are articulated inertias.

    `m` has what is `added` in it. The second function returns the diagonal of the
    inverse of M, infinite where a pivot is not positive.
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
        # The pivots after one that is not positive are not numbers.
        singular = (m.m33 <= 0) | (pivot2 <= 0) | (pivot1 <= 0)
        first, second, third = (
            jnp.where(singular, jnp.inf, i) for i in (inverse1, second, third)
        )
        return first, second, third

    return solve, inverse_diagonal


def _subtract(a: Scalars, b: Scalars) -> Scalars:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _with(added: Added | None, m: Equations) -> Equations:
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


def _rates(
    reciprocal: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    tau: Scalars,
    added: Added | None,
) -> tuple[Scalars, Scalars]:
    m = _with(added, equations(c, delta, qd))
    solve, _ = _solver(c, m, added, reciprocal)
    # The velocities pass through the loop because XLA would otherwise copy the buffers
    # of a Runge-Kutta method's stages.
    return qd, solve(_subtract(tau, m.bias))


def _rates_and_conditioning(
    reciprocal: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    tau: Scalars,
    added: Added | None,
) -> tuple[Scalars, Scalars, Array]:
    m = _with(added, equations(c, delta, qd))
    solve, inverse_diagonal = _solver(c, m, added, reciprocal)
    return qd, solve(_subtract(tau, m.bias)), _loss(m, inverse_diagonal())


def _loss(m: Equations, inverse: Scalars) -> Array:
    """What rounding is multiplied by in the accelerations."""
    i11, i22, i33 = inverse
    loss = jnp.maximum(m.m11 * i11, jnp.maximum(m.m22 * i22, m.m33 * i33))
    # An infinite inverse times a mass of zero.
    return jnp.where(i11 == jnp.inf, jnp.inf, loss)


def _conditioning(
    reciprocal: Callable, c: Constants, delta: Scalars, added: Added | None
) -> Array:
    zero = jnp.zeros_like(delta[0])
    m = _with(added, equations(c, delta, (zero, zero, zero)))
    _, inverse_diagonal = _solver(c, m, added, reciprocal)
    return _loss(m, inverse_diagonal())


def conditioning(c: Constants, delta: Scalars, added: Added | None = None) -> Array:
    """What rounding is multiplied by, as `rates_and_conditioning` returns it."""
    return _one_loop(_conditioning)(c, delta, added)


@jax.jit
def required_efforts(
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    qdd: Scalars,
    turned: Directions | None = None,
) -> Scalars:
    """The inverse dynamics: M qdd + bias."""
    m = equations(c, delta, qd, turned)
    y1, y2, y3 = times((m.m11, m.m12, m.m13, m.m22, m.m23, m.m33), qdd)
    b1, b2, b3 = m.bias
    return y1 + b1, y2 + b2, y3 + b3


def _directions_and_inverse(
    reciprocal: Callable, c: Constants, delta: Scalars, added: Added | None
) -> tuple[Directions, Matrix]:
    """The directions of the links, and the inverse of the mass matrix by columns."""
    turned = directions(c, delta)
    zero, one = jnp.zeros_like(delta[0]), jnp.ones_like(delta[0])
    m = _with(added, equations(c, delta, (zero, zero, zero), turned))
    solve, _ = _solver(c, m, added, reciprocal)
    unit = (one, zero, zero), (zero, one, zero), (zero, zero, one)
    return turned, (solve(unit[0]), solve(unit[1]), solve(unit[2]))


def _demanded_change(
    reciprocal: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    qdd: Scalars,
    turned: Directions,
    direction: tuple[Scalars, Scalars],
) -> Scalars:
    """Derivative of the efforts that `qdd` takes, in a direction of (delta, qd)."""
    del reciprocal  # nothing is divided
    delta_dot, qd_dot = direction
    turned_dot = tuple(
        (-e[1] * angle, e[0] * angle) for e, angle in zip(turned, turns(c, delta_dot))
    )
    _, change = jax.jvp(
        lambda delta, qd, turned: required_efforts(c, delta, qd, qdd, turned),
        (delta, qd, turned),
        (delta_dot, qd_dot, turned_dot),
    )
    return change


def _unit_directions(dtype: Any) -> tuple[Scalars, Scalars]:
    rows = tuple(jnp.eye(6, dtype=dtype))
    return rows[:3], rows[3:]


def _derivatives(
    evaluated: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    qdd: Scalars,
    added: Added | None,
) -> tuple[Scalars, Matrix]:
    # Sines and cosines first, and only once: XLA would compute them anew for each of
    # the results that follow. A single arm's derivatives are 1.7 times faster so.
    turned, inverse = evaluated(_directions_and_inverse)(c, delta, added)
    # The six directions are lanes of one loop, whose code has then the size of one.
    demanded = jax.vmap(
        lambda d: evaluated(_demanded_change)(c, delta, qd, qdd, turned, d)
    )(_unit_directions(delta[0].dtype))
    # No derivative goes through the solution of the equations.
    by_state: Any = tuple(
        -sum(column[row] * change for column, change in zip(inverse, demanded))
        for row in range(3)
    )
    return by_state, inverse


def _plain_sensitivities(*arguments):
    return _derivatives(
        lambda function: functools.partial(function, _divided), *arguments
    )


@jax.custom_jvp
def _one_loop_sensitivities(
    c: Constants, delta: Scalars, qd: Scalars, qdd: Scalars, added: Added | None
) -> tuple[Scalars, Matrix]:
    """Derivatives of the accelerations: three rows in (delta, qd), columns in tau."""
    return _derivatives(_one_loop, c, delta, qd, qdd, added)


@_one_loop_sensitivities.defjvp
def _sensitivities_jvp(primals, tangents):
    return jax.jvp(_plain_sensitivities, primals, tangents)


_sensitivities = jax.jit(_one_loop_sensitivities)  # traced once, not at each use


@jax.custom_jvp
def rates(
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    tau: Scalars,
    added: Added | None = None,
) -> tuple[Scalars, Scalars]:
    """Rates of the joint displacements `delta` from the reference of `c`, and of `qd`.

    The equations of motion as what an integrator takes: velocities and accelerations.
    """
    return _one_loop(_rates)(c, delta, qd, tau, added)


def _rates_jvp(primals, tangents):
    c, delta, qd, _, added = primals
    values = rates(*primals)
    by_state, by_tau = _sensitivities(c, delta, qd, values[1], added)
    c_dot, *others, added_dot = tangents
    delta_dot, qd_dot, efforts_dot = map(_dense, others)
    moved = jnp.stack((*delta_dot, *qd_dot))
    change = tuple(row @ moved for row in by_state)
    if not all(isinstance(step, SymbolicZero) for step in jax.tree.leaves(c_dot)):
        _, demanded = jax.jvp(
            lambda c: required_efforts(c, delta, qd, values[1]), (c,), (_dense(c_dot),)
        )
        efforts_dot = _subtract(efforts_dot, demanded)
    if added is not None:
        demanded = times(_dense(added_dot), values[1])
        efforts_dot = _subtract(efforts_dot, demanded)
    for column, effort in zip(by_tau, efforts_dot):
        change = tuple(a + b * effort for a, b in zip(change, column))
    return values, (qd_dot, change)


def _dense(tangents: Any) -> Any:
    def filled(step: Any) -> Any:
        if type(step) is not SymbolicZero:
            return step
        shape: Any = step.shape
        dtype: Any = step.dtype
        return np.zeros(shape, dtype)

    return jax.tree.map(filled, tangents)


rates.defjvp(_rates_jvp, symbolic_zeros=True)


@jax.custom_jvp
def rates_and_conditioning(
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    tau: Scalars,
    added: Added | None = None,
) -> tuple[tuple[Scalars, Scalars], Array]:
    """`rates`, and what rounding is multiplied by: 1 over the least inertia ratio.

    See `inertia_ratios`. Infinite where the mass matrix is not positive definite.
    Derivatives take it for a constant.
    """
    qd, qdd, loss = _one_loop(_rates_and_conditioning)(c, delta, qd, tau, added)
    return (qd, qdd), loss


@rates_and_conditioning.defjvp
def _rates_and_conditioning_jvp(primals, tangents):
    values, loss = rates_and_conditioning(*primals)
    _, change = jax.jvp(rates, primals, tangents)
    return (values, loss), (change, jnp.zeros_like(loss))


def inertia_diagonals(
    c: Constants, delta: Scalars, added: Added | None = None
) -> tuple[Scalars, Scalars]:
    """The diagonals of the mass matrix and of its inverse, infinite if it has none."""
    zero = jnp.zeros_like(delta[0])
    m = _with(added, equations(c, delta, (zero, zero, zero)))
    _, inverse_diagonal = _solver(c, m, added, _divided)
    return (m.m11, m.m22, m.m33), inverse_diagonal()
