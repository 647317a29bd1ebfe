"""Zeros of functions of time within a step, by polynomials through samples."""

import functools
import operator

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
# Between them, further samples show whether the polynomials hold: at two more stages,
# and within the longest gap.
CHECKED = 1, 4
CHECKS = np.append(NODES[list(CHECKED)], 0.8)
# The polynomials are sums of Chebyshev's, in x from -1 to 1 along the step.
_ORDERS = np.arange(len(SHARES))
_BASIS = np.polynomial.chebyshev.chebvander
_TERMS = np.linalg.inv(_BASIS(2 * SHARES - 1, _ORDERS[-1]))
_SLOPE = 2 * _ORDERS**2 @ _TERMS  # at the end, per step
_BEND = 4 * _ORDERS**2 * (_ORDERS**2 - 1) / 3 @ _TERMS  # second derivative there
_AT_CHECKS = _BASIS(2 * CHECKS - 1, _ORDERS[-1]) @ _TERMS
_SLOPES = (
    2
    * np.polynomial.chebyshev.chebval(
        2 * SHARES - 1, np.polynomial.chebyshev.chebder(_TERMS)
    ).T
)  # at the samples
# Steps end where a switching function has passed its zero by this power of the unit of
# rounding, times its size, and by this multiple of it. There the side to which the
# motion goes is known even if it began at rest on the zero.
_BEYOND, _ROUNDING = 0.75, 500
_WRONG = 0.375  # power of it, over a size: so far from zero no step has ended
_SOON = 0.01  # of a step, for extrapolation
# A function that turns back within this share of its size nearly touches its zero.
_MISSED = 0.01
# Of slopes and second derivatives, in units of rounding.
_SLOPE_NOISE, _NOISE = (4 * np.abs(weights).sum() for weights in (_SLOPE, _BEND))
_ITERATIONS = 6  # of Newton's method within a bracket
# Elsewhere the error of polynomials is less than so many times what is seen of it. A
# distance that falls and rises within a step needs 10, wherever it turns.
_ELSEWHERE = 12


def _times(weights: np.ndarray, values: Array) -> Array:
    """Returns a matrix product, in a batch 5 times as fast as by a sum over an axis.

    For small ones XLA would call a library.
    """
    factors = jnp.asarray(weights, values.dtype)[..., None]
    rows = jnp.broadcast_to(values, (*factors.shape[:-1], values.shape[-1]))
    terms = (factors[..., k, :] * rows[..., k, :] for k in range(len(values)))
    return functools.reduce(operator.add, terms)


def _turns(margins: Array, least: Array) -> tuple[Array, Array]:
    """Returns where margins turn back to rising between two samples, and their values.

    These are the shares of the step and the values of cubics, infinite if there is no
    such place. `least`: smaller changes are rounding.
    """
    lengths = jnp.asarray(np.diff(SHARES), margins.dtype)[:, None]
    slopes, change = _times(_SLOPES, margins), margins[1:] - margins[:-1]
    fall, rise = slopes[:-1] * lengths, slopes[1:] * lengths
    turning = (-fall > least[None]) & (rise > least[None])
    fall, rise = jnp.where(turning, fall, -1), jnp.where(turning, rise, 1)
    mean = fall + rise - 3 * change
    root = jnp.sqrt(mean**2 - fall * rise)
    part = (mean + root - fall) / (rise - fall + 2 * root)
    bend = part * (fall + rise - 2 * change) - mean - fall
    values = margins[:-1] + part * (fall + part * bend)
    shares = jnp.asarray(SHARES[:-1], margins.dtype)[:, None] + part * lengths
    return shares, jnp.where(turning, values, jnp.inf)


def _uncertainty(margins: Array, checks: Array, sizes: Array) -> Array:
    """Returns how far the margins may be from polynomials between samples.

    The error shows in the polynomials' last terms and at the further samples `checks`.
    What may be rounding does not count, as shorter steps have it too.
    """
    last = jnp.abs(_times(_TERMS[-2:], margins))
    wrong = jnp.abs(checks - _times(_AT_CHECKS, margins))
    error = jnp.maximum(jnp.max(last, axis=0), jnp.max(wrong, axis=0))
    rounding = _ROUNDING * jnp.finfo(margins.dtype).eps * (1 + sizes)
    return _ELSEWHERE * jnp.maximum(error - rounding, 0)


def _beyond(margins: Array) -> tuple[Array, Array]:
    """Returns margins from the places where steps end beyond zeros, and how far."""
    eps = jnp.finfo(margins.dtype).eps
    beyond = eps**_BEYOND * jnp.max(jnp.abs(margins), axis=0) + _ROUNDING * eps
    return margins + beyond[None], beyond


def _hiding_place(margins: Array, unsure: Array, begun: Array, near: Array) -> Array:
    """Returns a share of the step where a margin may pass 0 unseen, or else 1.

    It is in the middle of two samples. `unsure`: see `_uncertainty`; `begun`: which
    margins begin on their zeros, as after a switch.
    """
    # Margins on their zeros at the ends do not turn back within.
    ending = jnp.abs(margins[-1]) <= -_times(_SLOPE, margins) * near
    margins, beyond = _beyond(margins)
    _, lowest = _turns(margins, beyond)  # as in `first_zero`; XLA computes them once
    inner = margins.at[0].add(jnp.where(begun, jnp.inf, 0))
    inner = inner.at[-1].add(jnp.where(ending, jnp.inf, 0))
    lowest = jnp.minimum(lowest, jnp.minimum(inner[:-1], inner[1:]))
    lowest = jnp.where(unsure[None] > 0, lowest - unsure[None], jnp.inf)
    lowest = jnp.min(lowest, axis=1, initial=jnp.inf)
    middles = jnp.asarray((SHARES[1:] + SHARES[:-1]) / 2, margins.dtype)
    return jnp.where(jnp.min(lowest) < 0, middles[jnp.argmin(lowest)], 1)


@eqx.filter_jit
def passage(
    margins: Array,
    checks: Array,
    begun: Array,
    before: Array,
    sizes: Array,
    near: Array,
    brief: Array,
) -> tuple[Array, ...]:
    """Returns the results of `first_zero`, `_hiding_place` and `at_end`.

    If all margins stay far from 0, these are (1, False, 0), 1 and (False, 0, 0), and
    none is evaluated.

    `checks`: the margins at further places of the step; `begun`: which began on their
    zeros; `before`, `sizes`: the largest sizes in steps before, and with this one;
    `brief`: whether the step is so short that nothing is looked for in between.
    """
    unsure = jnp.where(brief, 0, _uncertainty(margins, checks, sizes))
    # Each slope pulls a cubic by at most 4/27 of its length beyond its ends.
    slopes = jnp.abs(_times(_SLOPES, margins))
    lengths = jnp.asarray(np.diff(SHARES), margins.dtype)[:, None]
    pulled = 4 / 27 * jnp.max(lengths * (slopes[:-1] + slopes[1:]), axis=0)
    least = jnp.maximum(pulled + _MISSED * sizes, _SOON * slopes[-1])
    far = jnp.all(margins > (least + unsure)[None]) & (near < _SOON)
    zero = jnp.zeros((), margins.dtype)
    no = jnp.zeros(margins.shape[1:], bool)
    return jax.lax.cond(
        far,
        lambda: (zero + 1, no.any(), zero, zero + 1, no, zero, zero),
        lambda: (
            *first_zero(margins, before, unsure),
            _hiding_place(margins, unsure, begun, near),
            *at_end(margins, sizes, near),
        ),
    )


def first_zero(
    margins: Array, sizes: Array, unsure: Array
) -> tuple[Array, Array, Array]:
    """Returns the share of a step where a margin first passes 0, and whether any does.

    Also returns how near to grazing a margin turned back, 0 if not near (see `at_end`).
    `sizes`: the largest size of each margin in steps before; `unsure`: a margin that
    falls by less between two samples is left to `_hiding_place`.
    """
    if not margins.size:
        none = jnp.zeros((), margins.dtype)
        return none + 1, jnp.array(False), none
    margins, beyond = _beyond(margins)
    # What is on the wrong side from the start on, as after a jump, changes at once,
    # however little is known of the rest of the step.
    size = jnp.max(jnp.abs(margins), axis=0)
    far = -margins[0] > jnp.finfo(size.dtype).eps ** _WRONG * size
    wrong = jnp.any(far & (margins[1] < 0))
    turns, lowest = _turns(margins, beyond)
    shares = jnp.asarray(SHARES, margins.dtype)
    ends = jnp.where(lowest < 0, turns, shares[1:, None])
    after = jnp.where(lowest < 0, lowest, margins[1:])
    after = jnp.where(margins[:-1] - after < unsure[None], jnp.inf, after)
    passed = (after < 0).any(axis=1)
    index = jnp.argmax(passed)
    before, after, low = jnp.abs(margins[index]), after[index], shares[index]
    chord = jnp.where(after < 0, before / (before - after), jnp.inf)
    guesses = low + chord * (ends[index] - low)
    first = jnp.argmin(guesses)
    guess, high = guesses[first], ends[index, first]
    terms = lambda: _times(_TERMS, margins[:, first, None])[:, 0]
    zero = jax.lax.cond(
        passed.any(),
        lambda: _zero(terms(), guess, low, high),
        lambda: jnp.ones_like(low),
    )
    # A margin that turns back just before its zero counts as if it had gone as far
    # beyond: this is the speed of that crossing.
    near = jnp.max(jnp.maximum(sizes[None], margins[:-1]) / lowest)
    near = jnp.where(near * _MISSED > 1, jnp.sqrt(jnp.maximum(near, 0)), 0)
    return jnp.where(wrong, 0, zero), passed.any() | wrong, near


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


def at_end(margins: Array, sizes: Array, near: Array) -> tuple[Array, Array, Array]:
    """Returns which margins are near their zeros at the step's end, and how they graze.

    Also returns the share of the step after which something else follows soon, or 0.
    `sizes`: the largest size of each margin, also in steps before. `near`: a share of
    the step.
    """
    nearer = -_times(_SLOPE, margins)
    # Where the slope is rounding, as in a step of almost no length, the side counts.
    moves = jnp.abs(nearer) > _SLOPE_NOISE * jnp.finfo(sizes.dtype).eps * sizes
    speed = jnp.where(moves, nearer, 1)
    left = margins[-1] / speed
    switched = jnp.where(moves, (nearer > 0) & (left <= near), margins[-1] < 0)
    # A small slope for the step, or a zero after which the margin would soon turn back.
    # The latter shows in short steps too, where the size is that of the slope.
    bend = _times(_BEND, margins) - _NOISE * jnp.finfo(sizes.dtype).eps * sizes
    turning = jnp.sqrt(2 * sizes * jnp.maximum(bend, 0))
    grazing = jnp.maximum(jnp.max(jnp.abs(margins), axis=0), turning) / speed
    follows = moves & (nearer > 0) & (left > near) & (left < _SOON)
    soon = jnp.where(follows, left, jnp.inf).min(initial=jnp.inf)
    soon = jnp.where(soon < jnp.inf, soon, 0)
    return switched, jnp.where(switched & moves, grazing, 0).max(initial=0), soon
