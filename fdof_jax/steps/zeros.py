"""Zeros of functions of time within a step, by polynomials through samples."""

import functools
import operator
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.one_loop import in_one_loop
from .dopri8 import AT_END, IN_GAP, SCHEDULE_SHARES

# Samples are taken at stages of the method of order 8, for which the integrators have
# evaluated what depends on time alone.
SAMPLED = 0, 3, 5, 7, 8, 9, 10, AT_END
SHARES = SCHEDULE_SHARES[list(SAMPLED)]  # of the step
# Between them, further samples show whether the polynomials hold: at two more stages,
# and within the longest gap.
CHECKED = 1, 4, IN_GAP
CHECKS = SCHEDULE_SHARES[list(CHECKED)]
# The polynomials are sums of Chebyshev's, in x from -1 to 1 along the step.
_ORDERS = np.arange(len(SHARES))
_BASIS = np.polynomial.chebyshev.chebvander
_TERMS = np.linalg.inv(_BASIS(2 * SHARES - 1, _ORDERS[-1]))
_BEND = 4 * _ORDERS**2 * (_ORDERS**2 - 1) / 3 @ _TERMS  # second derivative there
_AT_CHECKS = _BASIS(2 * CHECKS - 1, _ORDERS[-1]) @ _TERMS
_LENGTHS = np.diff(SHARES)
_MIDDLES = SHARES[:-1] + _LENGTHS / 2
_SLOPES = (
    2
    * np.polynomial.chebyshev.chebval(
        2 * SHARES - 1, np.polynomial.chebyshev.chebder(_TERMS)
    ).T
)  # at the samples, per step
# Steps end where a switching function has passed its zero by this power of the unit of
# rounding, times its size up to there, and by this multiple of it. There the side to
# which the motion goes is known even if it began at rest on the zero.
OFFSET, ROUNDING = 0.75, 500
_WRONG = 0.375  # power of it, over a size: so far from zero no step has ended
_SOON = 0.01  # of a step, for extrapolation
# A function that turns back within this share of its size nearly touches its zero.
_MISSED = 0.01
# Of slopes and second derivatives, in units of rounding.
_SLOPE_NOISE, _NOISE = (4 * np.abs(weights).sum() for weights in (_SLOPES[-1], _BEND))
_ITERATIONS = 6  # of Newton's method within a bracket
# Elsewhere the error of polynomials is less than so many times what is seen of it. A
# distance that falls and rises within a step needs 10, wherever it turns.
_ELSEWHERE = 12


class _Margin(NamedTuple):
    """Switching functions in a step, positive on the side in force: (n,) each."""

    past: Array  # (sample, n), from the places where steps end, beyond the zeros
    slopes: Array  # (sample, n), per step
    offset: Array  # how far these places are from the zeros
    largest: Array  # the largest value on either side
    unsure: Array  # how far a margin may be from its polynomial between samples
    bend: Array  # second derivative at the end


def _sum(weights: np.ndarray, rows: Sequence[Array]) -> Array:
    """Returns a weighted sum of rows; for an array, XLA would call a library."""
    terms = (float(w) * row for w, row in zip(weights, rows))
    return functools.reduce(operator.add, terms)


def _largest(rows: Sequence[Array]) -> Array:
    return functools.reduce(jnp.maximum, map(jnp.abs, rows))


def _margins(
    values: Array, checks: Array, side: Array, before: Array, brief: Array
) -> _Margin:
    """Returns the margin of one function by its polynomial through `values`.

    Errors show in the polynomial's last terms and at the further samples `checks`;
    rounding does not count, as shorter steps have it too.
    """
    eps, largest = jnp.finfo(before.dtype).eps, _largest(tuple(values))
    rows, others = ([side * value for value in part] for part in (values, checks))
    last = [_sum(row, rows) for row in _TERMS[-2:]]
    wrong = [check - _sum(row, rows) for check, row in zip(others, _AT_CHECKS)]
    rounding = ROUNDING * eps * (1 + jnp.maximum(before, largest))
    unsure = _ELSEWHERE * jnp.maximum(_largest([*last, *wrong]) - rounding, 0)
    slopes = [_sum(row, rows) for row in _SLOPES]
    size = _size_of_motion(rows, slopes[0], largest)
    offset = eps**OFFSET * size + ROUNDING * eps
    past = [row + offset for row in rows]
    unsure, bend = jnp.where(brief, 0, unsure), _sum(_BEND, rows)
    past, slopes, *others = in_one_loop((past, slopes, offset, largest, unsure, bend))
    return _Margin(jnp.stack(past), jnp.stack(slopes), *others)


def _size_of_motion(rows: Sequence[Array], slope: Array, largest: Array) -> Array:
    """Returns the size of a margin up to its zero.

    A step that is tried may go far beyond. Before the second sample, `slope` gives a
    parabola. A margin that is on its zero and does not rise has no size but `largest`.
    """
    rise = jnp.maximum(slope * float(SHARES[1]), 0)
    over = (rise > 0) & (rows[1] < 0)
    top = jnp.where(over, rise**2 / (4 * jnp.where(over, rise - rows[1], 1)), 0)
    size, within = jnp.maximum(rows[0], top), jnp.ones_like(over)
    for row in rows[1:]:
        within &= row > 0
        size = jnp.where(within, jnp.maximum(size, row), size)
    on_zero = size <= jnp.finfo(largest.dtype).eps ** _WRONG * largest
    return jnp.where(on_zero, largest, size)


def _turns(margins: _Margin) -> tuple[Array, Array]:
    """Returns where margins turn back to rising between two samples, and their values.

    These are shares of the step and values of cubics, or else infinite.
    """
    past, slopes = margins.past, margins.slopes
    least = margins.offset  # smaller changes are rounding
    lengths = jnp.asarray(_LENGTHS, past.dtype)[:, None]
    change = past[1:] - past[:-1]
    fall, rise = slopes[:-1] * lengths, slopes[1:] * lengths
    turning = (-fall > least[None]) & (rise > least[None])
    fall, rise = jnp.where(turning, fall, -1), jnp.where(turning, rise, 1)
    mean = fall + rise - 3 * change
    root = jnp.sqrt(mean**2 - fall * rise)
    part = (mean + root - fall) / (rise - fall + 2 * root)
    bend = part * (fall + rise - 2 * change) - mean - fall
    values = past[:-1] + part * (fall + part * bend)
    shares = jnp.asarray(SHARES[:-1], past.dtype)[:, None] + part * lengths
    return in_one_loop((shares, jnp.where(turning, values, jnp.inf)))


class Passage(NamedTuple):
    """Zeros of switching functions in a step, and those at its end.

    - `until`: the share of the step where a margin first passes 0, else 1; `crossed`:
      whether any does.
    - `missed`: how near to grazing a margin turned back, 0 if not near.
    - `unseen`: a share, midway between two samples, where a margin may pass 0 unseen,
      or 1.
    - `switched` (n,): which margins are near zeros at the end; `grazing`: how they
      graze.
    - `soon`: the share after which another follows soon, or 0.
    - `sizes` (n,): the largest sizes so far.
    """

    until: Array
    crossed: Array
    missed: Array
    unseen: Array
    switched: Array
    grazing: Array
    soon: Array
    sizes: Array


@eqx.filter_jit
def passage(
    values: Array, checks: Array, sides: Array, begun: Array, before: Array,
    near: Array, brief: Array,
) -> Passage:  # fmt: skip
    """Returns where switching functions pass 0 in a step, and which do at its end.

    Margins are their values (sample, n) on the sides in force (n,). `checks`: values at
    further places; `begun`: which began on their zeros; `before`: the largest sizes
    before; `near`: a share of the step; `brief`: whether the step is too short to look
    for zeros in between.
    """
    if not before.size:
        zero, no = jnp.zeros((), values.dtype), jnp.zeros((), bool)
        return Passage(zero + 1, no, zero, zero + 1, before > 0, zero, zero, before)
    # XLA makes vectors of the lanes of a batch where functions come one by one.
    one = lambda function: _margins(*function, brief)  # pyright: ignore[reportCallIssue]
    margins = jax.lax.map(one, (values.T, checks.T, sides, before))
    margins = margins._replace(past=margins.past.T, slopes=margins.slopes.T)
    turns, lowest = _turns(margins)
    sizes = jnp.maximum(before, margins.largest)
    return Passage(
        *_first_zero(margins, turns, lowest, before),
        _hiding_place(margins, lowest, begun, near),
        *_at_end(margins, sides * values[-1], sizes, near),
        sizes,
    )


def _first_zero(
    margins: _Margin, turns: Array, lowest: Array, before: Array
) -> tuple[Array, Array, Array]:
    """Returns the first three parts of the `Passage`.

    A margin that falls by less than its possible error is left to `_hiding_place`.
    """
    past, unsure = margins.past, margins.unsure[None]
    # What is on the wrong side from the start on, as after a jump, changes at once,
    # however little is known of the rest of the step.
    least = jnp.finfo(past.dtype).eps ** _WRONG * margins.largest
    wrong = jnp.any((-past[0] > least) & (past[1] < 0))
    shares = jnp.asarray(SHARES, past.dtype)[:, None]
    ends = jnp.where(lowest < 0, turns, shares[1:])
    after = jnp.where(lowest < 0, lowest, past[1:])
    passed = (after < 0) & ~(past[:-1] - after < unsure)
    start = jnp.abs(past[:-1])
    chord = start / (start - jnp.where(passed, after, -1))
    guesses = jnp.where(passed, shares[:-1] + chord * (ends - shares[:-1]), jnp.inf)
    interval = jnp.argmin(jnp.min(guesses, axis=1))
    number = jnp.argmin(guesses[interval])
    guess = guesses[interval, number]
    passes = guess < jnp.inf
    low, high = shares[interval, 0], ends[interval, number]
    # The chord of a margin that rises at first, as after a bounce, says little.
    start, length = past[interval, number], high - low
    rise = margins.slopes[interval, number] * length
    bend = after[interval, number] - start - rise
    arched = (rise > 0) & (bend < 0)
    root = jnp.sqrt(jnp.maximum(rise**2 - 4 * bend * start, 0))
    parabola = low - (rise + root) / (2 * jnp.where(arched, bend, 1)) * length
    guess = jnp.where(arched, parabola, guess)
    zero = jax.lax.cond(
        passes,
        lambda: _zero(past[:, number], guess, low, high),
        lambda: jnp.ones_like(guess),
    )
    # A margin that turns back just before its zero counts as if it had gone as far
    # beyond: this is the speed of that crossing.
    near = jnp.max(jnp.maximum(before[None], past[:-1]) / lowest)
    near = jnp.where(near * _MISSED > 1, jnp.sqrt(jnp.maximum(near, 0)), 0)
    return jnp.where(wrong, 0, zero), passes | wrong, near


def _hiding_place(margins: _Margin, lowest: Array, begun: Array, near: Array) -> Array:
    """Returns a share of the step where a margin may pass 0 unseen, else 1."""
    past, unsure = margins.past, margins.unsure[None]
    # Margins on their zeros at the ends do not turn back within.
    ending = jnp.abs(past[-1] - margins.offset) <= -margins.slopes[-1] * near
    inner = past.at[0].add(jnp.where(begun, jnp.inf, 0))
    inner = inner.at[-1].add(jnp.where(ending, jnp.inf, 0))
    lowest = jnp.minimum(lowest, jnp.minimum(inner[:-1], inner[1:]))
    lowest = jnp.where(unsure > 0, lowest - unsure, jnp.inf)
    lowest = jnp.min(lowest, axis=1)
    middles = jnp.asarray(_MIDDLES, past.dtype)
    return jnp.where(jnp.min(lowest) < 0, middles[jnp.argmin(lowest)], 1)


def _at_end(
    margins: _Margin, last: Array, sizes: Array, near: Array
) -> tuple[Array, Array, Array]:
    """Returns what is at the step's end; `last`: the margins there."""
    eps, nearer = jnp.finfo(sizes.dtype).eps, -margins.slopes[-1]
    # Where the slope is rounding, as in a step of almost no length, the side counts.
    moves = jnp.abs(nearer) > _SLOPE_NOISE * eps * sizes
    speed = jnp.where(moves, nearer, 1)
    left = last / speed
    switched = jnp.where(moves, (nearer > 0) & (left <= near), last < 0)
    # A small slope for the step, or a zero after which the margin would soon turn back.
    # The latter shows in short steps too, where the size is that of the slope.
    bend = margins.bend - _NOISE * eps * sizes
    turning = jnp.sqrt(2 * sizes * jnp.maximum(bend, 0))
    grazing = jnp.maximum(margins.largest, turning) / speed
    follows = moves & (nearer > 0) & (left > near) & (left < _SOON)
    soon = jnp.where(follows, left, jnp.inf).min()
    soon = jnp.where(soon < jnp.inf, soon, 0)
    return switched, jnp.where(switched & moves, grazing, 0).max(), soon


def _zero(past: Array, guess: Array, low: Array, high: Array) -> Array:
    """Returns the zero of a margin's polynomial in a bracket, by Newton."""
    terms = [_sum(row, tuple(past)) for row in _TERMS]

    def nearer(_, state):
        share, low, high = state
        x = 2 * share - 1
        # Clenshaw's recurrence, and its derivative in x
        b, c, db, dc = (jnp.zeros_like(x),) * 4
        for term in reversed(terms[1:]):
            b, c, db, dc = 2 * x * b - c + term, b, 2 * (b + x * db) - dc, db
        value, slope = x * b - c + terms[0], 2 * (b + x * db - dc)
        low, high = jnp.where(value > 0, share, low), jnp.where(value > 0, high, share)
        new = share - value / jnp.where(slope == 0, 1, slope)
        inside = (new >= low) & (new <= high)
        return jnp.where(inside, new, (low + high) / 2), low, high

    return jax.lax.fori_loop(0, _ITERATIONS, nearer, (guess, low, high))[0]
