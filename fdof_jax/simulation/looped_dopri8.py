"""Dormand-Prince 8(7) with a loop over its stages: one copy of the equations.

Where XLA compiles the loop as one kernel, a single arm is solved about as fast as with
unrolled stages, after less than half the time of compilation. diffrax's own Dopri8 is
such a loop too. This one is compiled a tenth sooner, and its derivatives in two thirds
of the time: it is traced once and does without what other methods need.
"""

from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import Array
from jaxtyping import PyTree

from .dopri8 import (
    LOWER,
    NODES,
    STAGES,
    TABLEAU,
    DenseOutput,
    ScheduledTerm,
    constant,
    interpolation_weights,
    verdict,
)


def _weighted(weights: Array, rates: PyTree) -> PyTree:
    """The sum of the rates at all stages, each times its weight."""
    # XLA would call a library for products of matrices: too much for so small ones.
    return jtu.tree_map(lambda k: jnp.sum(weights * k), rates)


class _Step(NamedTuple):
    """The end of a step and its error; the rates at all stages; its health.

    `lost` is what the rounding of `y` took away. The next step adds it (Kahan).
    """

    y: PyTree
    error: PyTree
    lost: PyTree
    rates: PyTree
    health: Array


# In reverse mode steps are replayed, by the very code that took them: next to a
# saturation another rounding leads to other steps, and to a wrong gradient.
@eqx.filter_jit  # traced once, not at each of a solve's uses of it
@eqx.filter_checkpoint
def _step(term: Any, t0, t1, y0, lost, args, f0) -> tuple[_Step, Array]:
    # diffrax wraps the term, to integrate backward in time too.
    inner, h = term.term, term.contr(t0, t1)
    times = (t0 + (t1 - t0) * jnp.asarray(NODES, t0.dtype)) * term.direction
    schedule = jax.vmap(inner.schedule, in_axes=(0, None))(times[1:], args)
    lower = jnp.asarray(LOWER, h.dtype)

    def stage(rates, row):
        index, t, weights, scheduled = row
        y = jtu.tree_map(lambda a, k: a + h * k, y0, _weighted(weights, rates))
        rate = inner.vector_field(t, y, args, scheduled)
        return jtu.tree_map(lambda ks, k: ks.at[index].set(k), rates, rate), None

    rates = jtu.tree_map(lambda k: jnp.zeros(STAGES, k.dtype).at[0].set(k), f0)
    stages = jnp.arange(1, STAGES), times[1:], lower, schedule
    rates, _ = jax.lax.scan(stage, rates, stages)
    change = jtu.tree_map(lambda k, c: h * k + c, _weighted(lower[-1], rates), lost)
    y = jtu.tree_map(lambda a, b: a + b, y0, change)
    lost = jtu.tree_map(lambda a, b, c: c - (b - a), y0, y, change)
    weights = jnp.asarray(TABLEAU.b_error, h.dtype)
    error = jtu.tree_map(lambda k: h * k, _weighted(weights, rates))
    # An infinity beside a NaN would get past diffrax, and leave no step length.
    last = jtu.tree_map(lambda k: k[-1], rates)
    finite = jnp.isfinite(sum(jtu.tree_leaves((y, last))))
    # Where a step led nowhere its start tells why.
    judged = jtu.tree_map(lambda a, b: jnp.where(finite, a, b), y, y0)
    health = inner.health(times[-1], *constant((judged, args)))
    health = jnp.where(finite | (health == 0), health, jnp.nan)
    y = jtu.tree_map(lambda a: jnp.where(finite, a, jnp.nan), y)
    error, lost = constant((error, lost))
    return _Step(y, error, lost, rates, health), h


class _Interpolation(DenseOutput):
    def at(self, theta):
        change = _weighted(interpolation_weights(theta), self.rates)
        return jtu.tree_map(lambda a, k: a + self.step * k, self.y0, change)


class LoopedDopri8(diffrax.AbstractAdaptiveSolver):
    """The method of `diffrax.Dopri8`, equal to rounding, for a single arm."""

    term_structure: ClassVar = ScheduledTerm
    interpolation_cls: ClassVar = _Interpolation

    def order(self, terms) -> int:
        return 8

    def init(self, terms, t0, t1, y0, args):
        return self.func(terms, t0, y0, args), jtu.tree_map(jnp.zeros_like, y0)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        # A jump has changed the rates at the start of the step.
        f0, lost = solver_state
        if made_jump is not False:
            fresh = self.func(terms, t0, y0, args)
            f0 = jtu.tree_map(lambda a, b: jnp.where(made_jump, a, b), fresh, f0)
        end, h = _step(terms, t0, t1, y0, lost, args, f0)
        dense_info = dict(y0=y0, step=h, rates=end.rates)
        last = jtu.tree_map(lambda k: k[-1], end.rates)
        bad = jnp.isnan(end.health) | (end.health == 0)
        imposed, result = verdict(end.health == 0, bad, h)
        error = jtu.tree_map(lambda e: jnp.where(bad, imposed, e), end.error)
        return end.y, error, dense_info, (last, end.lost), result

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)
