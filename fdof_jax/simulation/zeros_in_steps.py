"""Zeros of functions of time within a step, by polynomials through samples."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .dopri8 import NODES

# Samples are taken at stages of the method of order 8, for which the integrators have
# evaluated what depends on time alone.
SAMPLED = 0, 3, 5, 7, 8, 9, 10, -1
SHARES = NODES[list(SAMPLED)]  # of the step
# The polynomials are sums of Chebyshev's, in x from -1 to 1 along the step.
_ORDERS = np.arange(len(SHARES))
_BASIS = np.polynomial.chebyshev.chebvander
_TERMS = np.linalg.inv(_BASIS(2 * SHARES - 1, _ORDERS[-1]))
_SLOPE = 2 * _ORDERS**2 @ _TERMS  # at the end, per step
_BEND = 4 * _ORDERS**2 * (_ORDERS**2 - 1) / 3 @ _TERMS  # second derivative there
# Signs are examined at the samples and between those that are far apart.
_BETWEEN = np.array([0.06, 0.25, 0.79, 0.96])
_TO_BETWEEN = _BASIS(2 * _BETWEEN - 1, _ORDERS[-1]) @ _TERMS
_FINER = np.concatenate([SHARES, _BETWEEN])
_SORTED = np.argsort(_FINER)
# Steps end where a switching function has passed its zero by this power of the unit of
# rounding, times its size, and by this multiple of it. At rest on the zero it can be
# told there to which side the motion goes.
BEYOND, _ROUNDING = 0.625, 500
_SOON = 0.01  # of a step, for extrapolation
_NOISE = 4 * np.abs(_BEND).sum()  # of the second derivative, in units of rounding
_ITERATIONS = 6  # of Newton's method within a bracket


def _times(weights: np.ndarray, values: Array) -> Array:
    """Returns a matrix product; for small ones XLA would call a library."""
    factors = jnp.asarray(weights, values.dtype)[..., None]
    values = jnp.broadcast_to(values, (*factors.shape[:-1], values.shape[-1]))
    return jnp.sum(factors * values, axis=-2)


def slope_at_end(values: Array) -> Array:
    """Returns the slopes at the end, per step, of values at the samples."""
    return _times(_SLOPE, values)


def bend_at_end(values: Array) -> Array:
    """Returns the second derivatives at the end, per step squared."""
    return _times(_BEND, values)


@eqx.filter_jit
def first_zero(margins: Array) -> tuple[Array, Array]:
    """Returns the share of a step where a margin passes 0, and whether one does."""
    if not margins.size:
        return jnp.ones((), margins.dtype), jnp.array(False)
    eps = jnp.finfo(margins.dtype).eps
    beyond = eps**BEYOND * jnp.max(jnp.abs(margins), axis=0) + _ROUNDING * eps
    margins = margins + beyond[None]
    finer = jnp.concatenate([margins, _times(_TO_BETWEEN, margins)])[_SORTED]
    # What is on the wrong side from the start on changes at once.
    wrong = jnp.any((finer[0] < 0) & (finer[1] < 0))
    finer = finer.at[0].set(jnp.abs(finer[0]))
    passed = (finer < 0).any(axis=1)
    index = jnp.maximum(jnp.argmax(passed), 1)
    before, after = finer[index - 1], finer[index]
    chord = jnp.where(after < 0, before / (before - after), jnp.inf)
    first = jnp.argmin(chord)
    shares = jnp.asarray(_FINER[_SORTED], margins.dtype)
    low, high = shares[index - 1], shares[index]
    guess = low + chord[first] * (high - low)
    terms = lambda: _times(_TERMS, margins[:, first, None])[:, 0]
    zero = jax.lax.cond(
        passed.any(),
        lambda: _zero(terms(), guess, low, high),
        lambda: jnp.ones_like(low),
    )
    return jnp.where(wrong, 0, zero), passed.any()


def _zero(terms: Array, guess: Array, low: Array, high: Array) -> Array:
    """Returns the zero of a sum of Chebyshev's polynomials in a bracket, by Newton."""

    def nearer(_, state):
        share, low, high = state
        x = 2 * share - 1
        # Clenshaw's recurrence, and its derivative in x
        b, c, db, dc = (jnp.zeros_like(x),) * 4
        for term in reversed([terms[order] for order in range(1, len(_ORDERS))]):
            b, c, db, dc = 2 * x * b - c + term, b, 2 * (b + x * db) - dc, db
        value, slope = x * b - c + terms[0], 2 * (b + x * db - dc)
        low, high = jnp.where(value > 0, share, low), jnp.where(value > 0, high, share)
        new = share - value / jnp.where(slope == 0, 1, slope)
        inside = (new >= low) & (new <= high)
        return jnp.where(inside, new, (low + high) / 2), low, high

    return jax.lax.fori_loop(0, _ITERATIONS, nearer, (guess, low, high))[0]


@eqx.filter_jit
def at_end(margins: Array, sizes: Array, near: Array) -> tuple[Array, Array, Array]:
    """Returns what is `near` its zero at the end, and how close that is to grazing.

    Also returns the share of the step after which something else follows soon, or 0.
    `sizes`: the largest size of each margin, also in steps before.
    """
    nearer = -slope_at_end(margins)
    moves = nearer != 0  # in a step of some length
    speed = jnp.where(moves, nearer, 1)
    left = margins[-1] / speed
    switched = jnp.where(moves, (nearer > 0) & (left <= near), margins[-1] < 0)
    # A small slope for the step, or a zero after which the margin would soon turn back.
    # The latter shows in short steps too, where the size is that of the slope.
    bend = bend_at_end(margins) - _NOISE * jnp.finfo(sizes.dtype).eps * sizes
    turning = jnp.sqrt(2 * sizes * jnp.maximum(bend, 0))
    grazing = jnp.maximum(jnp.max(jnp.abs(margins), axis=0), turning) / speed
    follows = moves & (nearer > 0) & (left > near) & (left < _SOON)
    soon = jnp.where(follows, left, jnp.inf).min(initial=jnp.inf)
    soon = jnp.where(soon < jnp.inf, soon, 0)
    return switched, jnp.where(switched & moves, grazing, 0).max(initial=0), soon
