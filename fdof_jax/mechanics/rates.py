"""The rates of a linkage's state for integrators, and their derivatives.

One fused loop computes all; XLA on CPU would evaluate the equations for each result.
"""

import functools
from collections.abc import Callable
from operator import add
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import PyTree

from ..base.trees import per_member
from .equations import (
    Constants,
    Directions,
    Equations,
    Scalars,
    Upper,
    directions,
    equations,
    turns,
    zeros,
)
from .solve import Matrix, divided, fused, minus, solver_of, times, with_added

# So many joints at most have accelerations and conditioning in one loop. XLA on CPU
# cuts a longer expression into many loops, which evaluate the sines 40 times.
_MOST_TOGETHER = 7


def _solved(
    reciprocal: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    added: Upper | None,
    turned: Directions | None = None,
) -> tuple[Equations, Callable, Callable]:
    """Returns the equations, and what `solver_of` returns for them."""
    m = with_added(added, equations(c, delta, qd, turned))
    return m, *solver_of(c, m, added, reciprocal)


def _rates(
    reciprocal: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    tau: Scalars,
    added: Upper | None,
) -> tuple[Scalars, Scalars]:
    m, solve, _ = _solved(reciprocal, c, delta, qd, added)
    # The velocities pass through the loop because XLA would otherwise copy the buffers
    # of a Runge-Kutta method's stages.
    return qd, solve(minus(tau, m.bias))


def _rates_and_conditioning(
    reciprocal: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    tau: Scalars,
    added: Upper | None,
) -> tuple[Scalars, Scalars, Scalars]:
    m, solve, inverse_diagonal = _solved(reciprocal, c, delta, qd, added)
    return qd, solve(minus(tau, m.bias)), _losses(m, inverse_diagonal())


def _losses(m: Equations, inverse: Scalars) -> Scalars:
    """Computes the amplification of rounding errors in each joint's acceleration."""
    # An infinite inverse times a mass of zero would be NaN.
    singular = functools.reduce(jnp.maximum, inverse) == jnp.inf
    return tuple(
        jnp.where(singular, jnp.inf, row[0] * entry)
        for row, entry in zip(m.mass, inverse)
    )


def losses(
    reciprocal: Callable, c: Constants, delta: Scalars, added: Upper | None
) -> Scalars:
    """Computes `conditioning` with a given reciprocal, and with derivatives."""
    m, _, inverse_diagonal = _solved(reciprocal, c, delta, zeros(delta), added)
    return _losses(m, inverse_diagonal())


def conditioning(c: Constants, delta: Scalars, added: Upper | None = None) -> Scalars:
    """Computes the amplification of rounding errors, see `rates_and_conditioning`."""
    return fused(losses)(c, delta, added)


def _holding(
    reciprocal: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    tau: Scalars,
    added: Upper | None,
) -> Scalars:
    m, solve, _ = _solved(reciprocal, c, delta, qd, added)
    net = minus(tau, m.bias)
    return minus(times(m.mass, solve(net)), net)


@jax.custom_jvp
def efforts_of_fixed(
    c: Constants, delta: Scalars, qd: Scalars, tau: Scalars, added: Upper | None = None
) -> Scalars:
    """Computes what holds the pairs that are fixed in `c`: M qdd + bias - tau."""
    return fused(_holding)(c, delta, qd, tau, added)


@efforts_of_fixed.defjvp
def _(primals, tangents):
    _, change = jax.jvp(functools.partial(_holding, divided), primals, tangents)
    return efforts_of_fixed(*primals), change


@jax.jit
def required_efforts(
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    qdd: Scalars,
    turned: Directions | None = None,
) -> Scalars:
    """Computes the inverse dynamics, M qdd + bias."""
    m = equations(c, delta, qd, turned)
    return tuple(map(add, times(m.mass, qdd), m.bias))


def _directions_and_inverse(
    reciprocal: Callable, c: Constants, delta: Scalars, added: Upper | None
) -> tuple[Directions, Matrix]:
    """Computes the links' directions and the columns of the inverse mass matrix."""
    turned = directions(c, delta)
    _, solve, _ = _solved(reciprocal, c, delta, zeros(delta), added, turned)
    unit = jnp.eye(len(delta), dtype=delta[0].dtype)
    return turned, tuple(solve(tuple(row)) for row in unit)


def _demanded_change(
    reciprocal: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    qdd: Scalars,
    turned: Directions,
    direction: tuple[Scalars, Scalars],
) -> Scalars:
    """Derivative of the efforts for given `qdd`, in a direction of (delta, qd)."""
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


def _derivatives(
    evaluated: Callable,
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    qdd: Scalars,
    added: Upper | None,
) -> tuple[Scalars, Matrix]:
    # Sines and cosines come first, as XLA would otherwise compute them anew for each of
    # the following results. This makes a single arm's derivatives 1.7 times faster.
    turned, inverse = evaluated(_directions_and_inverse)(c, delta, added)
    # As lanes of one loop, all directions need the code of only one.
    unit = tuple(jnp.eye(2 * len(delta), dtype=delta[0].dtype))
    demanded = jax.vmap(
        lambda d: evaluated(_demanded_change)(c, delta, qd, qdd, turned, d)
    )((unit[: len(delta)], unit[len(delta) :]))
    # The linear solve itself is not differentiated: qdd' = -M^-1 (change of efforts).
    by_state: Any = tuple(
        -sum(column[row] * change for column, change in zip(inverse, demanded))
        for row in range(len(delta))
    )
    return by_state, inverse


@jax.custom_jvp
def _one_loop_sensitivities(
    c: Constants, delta: Scalars, qd: Scalars, qdd: Scalars, added: Upper | None
) -> tuple[Scalars, Matrix]:
    """Derivatives of the accelerations: rows in (delta, qd), columns in tau."""
    return _derivatives(fused, c, delta, qd, qdd, added)


@_one_loop_sensitivities.defjvp
def _sensitivities_jvp(primals, tangents):
    plain = lambda function: functools.partial(function, divided)
    pair = jax.jvp(functools.partial(_derivatives, plain), primals, tangents)
    # Not all depends on all: one joint's inertia is the same at any position.
    return per_member(pair, primals)


_sensitivities = jax.jit(_one_loop_sensitivities)  # traced once, not at each use


@jax.custom_jvp
def rates(
    c: Constants, delta: Scalars, qd: Scalars, tau: Scalars, added: Upper | None = None
) -> tuple[Scalars, Scalars]:
    """Computes the rates of `delta` and `qd`: velocities and accelerations.

    `delta` are the joint displacements from the reference of `c`.
    """
    return fused(_rates)(c, delta, qd, tau, added)


def _change(primals, values, tangents) -> tuple[Scalars, Scalars]:
    """Tangents of the `values` of `rates`."""
    c, delta, qd, _, added = primals
    by_state, by_tau = _sensitivities(c, delta, qd, values[1], added)
    c_dot, *others, added_dot = tangents
    delta_dot, qd_dot, efforts_dot = map(_dense, others)
    moved = jnp.stack((*delta_dot, *qd_dot))
    change = tuple(row @ moved for row in by_state)
    if not all(isinstance(step, SymbolicZero) for step in jax.tree.leaves(c_dot)):
        _, demanded = jax.jvp(
            lambda c: required_efforts(c, delta, qd, values[1]), (c,), (_dense(c_dot),)
        )
        efforts_dot = minus(efforts_dot, demanded)
    if added is not None:
        demanded = times(_dense(added_dot), values[1])
        efforts_dot = minus(efforts_dot, demanded)
    for column, effort in zip(by_tau, efforts_dot):
        change = tuple(a + b * effort for a, b in zip(change, column))
    return qd_dot, change


def _dense(tangents: PyTree) -> PyTree:
    def filled(step: object) -> object:
        if type(step) is not SymbolicZero:
            return step
        shape: Any = step.shape
        dtype: Any = step.dtype
        return np.zeros(shape, dtype)

    return jax.tree.map(filled, tangents)


@functools.partial(rates.defjvp, symbolic_zeros=True)
def _rates_jvp(primals, tangents):
    values = rates(*primals)
    return values, _change(primals, values, tangents)


@jax.custom_jvp
def rates_and_conditioning(
    c: Constants, delta: Scalars, qd: Scalars, tau: Scalars, added: Upper | None = None
) -> tuple[tuple[Scalars, Scalars], Scalars]:
    """Computes `rates` and the amplification of rounding errors in them.

    It is 1 over the `inertia_ratios`, infinite where the mass matrix is not positive
    definite, and constant for derivatives.
    """
    if len(delta) > _MOST_TOGETHER:
        values = fused(_rates)(c, delta, qd, tau, added)
        return values, conditioning(c, delta, added)
    qd, qdd, losses = fused(_rates_and_conditioning)(c, delta, qd, tau, added)
    return (qd, qdd), losses


@functools.partial(rates_and_conditioning.defjvp, symbolic_zeros=True)
def _rates_and_conditioning_jvp(primals, tangents):
    values, losses = rates_and_conditioning(*primals)
    change = _change(primals, values, tangents)
    return (values, losses), (change, tuple(map(jnp.zeros_like, losses)))
