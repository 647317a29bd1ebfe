"""Dormand-Prince 8(7) with its stages unrolled, as a diffrax solver.

Each stage is one fused loop over the batch, without buffers: a batch of 1024 takes half
the time of diffrax's loop.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from ..base.one_loop import entries_in_one_loop, in_one_loop
from ..base.trees import chosen
from .dopri8 import (
    AT_END,
    DENSE,
    LOWER,
    SCHEDULE_SHARES,
    TABLEAU,
    DenseOutput,
    Estimate,
    ScheduledDopri8,
    compensated,
    interpolation_weights,
    scheduled_at_end,
    verdict,
)
from .term import Health, is_singular

_USED = [stage for stage, row in enumerate(DENSE) if row.any()]

State = PyTree  # of scalars
Rates = Sequence[State]  # one per stage


def _combine(coefficients: Sequence[Array] | np.ndarray, rates: Rates) -> PyTree:
    """Sums coefficients times rates, without terms that are known to be 0."""
    constants = isinstance(coefficients, np.ndarray)
    terms = [
        (float(c) if constants else c, rate)
        for c, rate in zip(coefficients, rates)
        if not (constants and c == 0)
    ]
    factors = [c for c, _ in terms]
    return jax.tree.map(
        lambda *leaves: sum(c * leaf for c, leaf in zip(factors, leaves)),
        *[rate for _, rate in terms],
    )


def _increment(row: np.ndarray, rates: Rates, y0: State, h: Array) -> State:
    """Sums coefficients times rates.

    Velocities at stages are sums of accelerations, so displacements are too.
    """
    others = [rate[1:] for rate in rates]
    accelerations = [rate[1] for rate in rates]
    share, twice = float(row.sum()), row @ LOWER
    twice = np.where(abs(twice) < 1e-14, 0, twice)  # but for rounding
    change = jax.tree.map(lambda v: share * v, y0[1])
    if twice.any():
        change = _moved(change, h, _combine(twice, accelerations))
    return (change, *_combine(row, others))


def _moved(y: State, h: Array, rate: State) -> State:
    return jax.tree.map(lambda a, k: a + h * k, y, rate)


class _End(NamedTuple):
    """The end of a step, with its error and what the next step needs.

    `rate` and its `health` are those at the end. `residue` is the rounding error of
    `y`, which the next step adds (Kahan).
    """

    y: State
    error: State
    residue: State
    rate: State
    health: Health


@eqx.filter_jit  # traced once, not at each use in a solve
def _step(term, t0, t1, y0, residue, args, f0) -> tuple[_End, dict[str, PyTree]]:
    h = t1 - t0
    times = t0 + h * jnp.asarray(SCHEDULE_SHARES, t0.dtype)
    # XLA makes vectors of the lanes, not of all stages of each, only in a loop.
    schedule = jax.lax.map(lambda t: entries_in_one_loop(term.schedule(t, args)), times)
    scheduled = lambda stage: jax.tree.map(lambda leaf: leaf[stage], schedule)
    field, rates = eqx.filter_jit(term.vector_field), [f0]
    weighted = lambda row: _increment(row, rates, y0, h)
    for stage, row in enumerate(LOWER[1:-1], 1):
        y = _moved(y0, h, weighted(row))
        rates.append(field(times[stage], y, args, scheduled(stage)))
    y, residue = compensated(y0, _moved(residue, h, weighted(LOWER[-1])))
    error = jax.tree.map(lambda k: h * k, weighted(TABLEAU.b_error))
    # diffrax's controllers overlook an infinity beside a NaN.
    poison = 0 * sum(jax.tree.leaves(y))
    y = jax.tree.map(lambda a: a + poison, y)
    y, error, residue = in_one_loop((y, error, residue))
    last, health = term.watched_field(times[AT_END], y, args, scheduled(AT_END))
    dense_info = dict(y0=y0, step=h, rates=[*rates, last], scheduled=schedule)
    return _End(y, error, residue, last, health), dense_info


class _Interpolation(DenseOutput):
    @property
    def rate_at_end(self):
        return self.rates[-1]

    @eqx.filter_jit
    def at(self, theta):
        weights = interpolation_weights(theta)
        change = _combine(
            [weights[stage] for stage in _USED], [self.rates[stage] for stage in _USED]
        )
        return in_one_loop(_moved(self.y0, self.step, change))


class UnrolledDopri8(ScheduledDopri8):
    """The method of `diffrax.Dopri8` up to rounding, for large batches.

    States begin with displacements and their rates. Derivatives take far longer to
    compile.
    """

    interpolation_cls: ClassVar = _Interpolation

    def init(self, terms, t0, t1, y0, args):
        return self._start(terms, t0, y0, args), jax.tree.map(jnp.zeros_like, y0)

    def _start(self, terms, t0, y0, args):
        return terms.watched_field(t0, y0, args, terms.schedule(t0, args))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        start, residue = solver_state
        if made_jump is not False:  # the stored rates are outdated after a jump
            start = chosen(made_jump, self._start(terms, t0, y0, args), start)
        f0, health = start
        end, dense_info = _step(terms, t0, t1, y0, residue, args, f0)
        # A singular start makes the end not finite.
        singular = is_singular(health)
        health = tuple(jnp.where(singular, 0, x) for x in end.health)
        scheduled = scheduled_at_end(dense_info["scheduled"])
        estimate = Estimate(end.error, health, scheduled)
        error, result = verdict(estimate, dense_info["step"])
        return end.y, error, dense_info, ((end.rate, end.health), end.residue), result
