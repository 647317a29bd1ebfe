"""Dormand and Prince's method of order 8(7): the common parts of its two solvers.

`LoopedDopri8` compiles faster and `UnrolledDopri8` runs faster in large batches. Both
agree with `diffrax.Dopri8` up to rounding.
"""

import functools
import operator
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

TABLEAU = diffrax.Dopri8.tableau
STAGES = len(TABLEAU.b_sol)
# Below this step size [s], rates that are not finite are not due to inaccuracy.
SHORTEST = {np.dtype("float64"): 1e-10, np.dtype("float32"): 1e-6}


def lower_triangle(tableau: diffrax.ButcherTableau) -> np.ndarray:
    """Returns the weights of rates in the increment before each stage, by rows."""
    rows = np.zeros((len(tableau.b_sol),) * 2)
    for row, entries in zip(rows[1:], tableau.a_lower):
        row[: len(entries)] = entries
    return rows


LOWER = lower_triangle(TABLEAU)  # its last row gives the whole step
# Shares of a step at which schedules are computed: those of the stages, the last one at
# the end, and one in the longest gap between them, for switching functions.
SCHEDULE_SHARES = np.concatenate([[0.0], TABLEAU.c, [0.8]])
AT_END, IN_GAP = STAGES - 1, STAGES  # rows of a schedule
_INTERPOLATION: Any = diffrax.Dopri8.interpolation_cls
DENSE = _INTERPOLATION.eval_coeffs  # (stage, power), highest first


# Equations have types of their own (`simulation.field.Args`), which steps do not know.
Integrated = PyTree  # a state: positions, rates, the elements' own
Arguments = PyTree  # of the equations: a named tuple with a linkage, q0 and sides
Term = Any  # a `ScheduledTerm`
Health = tuple[Array, ...]  # one per joint, see `ScheduledTerm`


class ScheduledTerm(diffrax.ODETerm):
    """A term whose vector field takes a fourth argument, which depends on time alone.

    `schedule(t, args)` computes this argument, in steps at all `SCHEDULE_SHARES`.
    `health(t, y, args)` holds the loss of accuracy in the rates of each joint, at least
    1, or 0 where the equations are singular. `watched_field` returns the rates and
    their health, NaN if they are not finite.
    `switching` returns the switching functions (n,), and with which something jumps.

    Where joints are held for a while, `args.modes` says which. `unknown_modes(args)`
    returns the modes before the start, and how many of the last switching functions
    guard them: positive while a mode lasts. `resolve(event, y, args)` returns the state
    and the modes after an event.

    Between samples of a controller, `args.sampled` holds what it has sampled. Where a
    step begins, `sample(t, y, args)`, if any, returns it anew, and whether it changed.

    `settle(t, y, args)`, if any, returns the state from which a step begins.
    """

    vector_field: Callable[..., PyTree] = eqx.field(static=True)
    schedule: Callable[..., PyTree] = eqx.field(static=True)
    health: Callable[..., Health] = eqx.field(static=True)
    watched_field: Callable[..., tuple[PyTree, Health]] = eqx.field(static=True)
    switching: Callable[..., tuple[Array, tuple[bool, ...]]] = eqx.field(static=True)
    unknown_modes: Callable | None = eqx.field(static=True, default=None)
    resolve: Callable | None = eqx.field(static=True, default=None)
    settle: Callable | None = eqx.field(static=True, default=None)
    sample: Callable | None = eqx.field(static=True, default=None)

    def vf(self, t, y, args):
        return self.vector_field(t, y, args, self.schedule(t, args))

    def switches(self, t, y, args) -> tuple[Array, tuple[bool, ...]]:
        return self.switching(t, y, args, self.schedule(t, args))


class ScheduledDopri8(diffrax.AbstractAdaptiveSolver):
    """Base of both solvers: the kind of their terms, and their order."""

    term_structure: ClassVar = ScheduledTerm
    tableau: ClassVar = TABLEAU

    def order(self, terms) -> int:
        return 8

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


def compensated(y0: PyTree, change: PyTree) -> tuple[PyTree, PyTree]:
    """Returns y0 + change and its rounding error, which the next change includes."""
    y = jax.tree.map(lambda a, b: a + b, y0, change)
    return y, jax.tree.map(lambda a, b, c: c - (b - a), y0, y, change)


def interpolation_weights(theta: Array) -> Array:
    """Weights (stage,) of the rates in the change over a fraction `theta` of a step."""
    weights = jnp.zeros(STAGES, theta.dtype)
    for coefficients in DENSE.T:  # Horner's rule for all stages at once
        weights = (weights + coefficients) * theta
    return weights


class DenseOutput(diffrax.AbstractLocalInterpolation):
    """Dense output as in diffrax; a subclass sums the weighted rates."""

    t0: Array  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: Array  # pyright: ignore[reportIncompatibleVariableOverride]
    y0: PyTree
    step: Array
    rates: PyTree
    scheduled: PyTree  # what depends on time alone, at `SCHEDULE_SHARES`

    @property
    @abstractmethod
    def rate_at_end(self) -> PyTree:
        """The rates at the end of the step."""

    @abstractmethod
    def at(self, theta: Array) -> PyTree:
        """Returns the state at a fraction `theta` of the step."""

    def evaluate(self, t0, t1=None, left=True):
        del t1, left  # for dense solutions, which no motion asks for
        length = self.t1 - self.t0
        safe = jnp.where(length == 0, 1, length)
        return self.at(jnp.where(length == 0, 0, (t0 - self.t0) / safe))


def constant(tree: PyTree) -> PyTree:
    """Returns the tree with its arrays constant for derivatives."""
    return jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree
    )


def chosen(condition: ArrayLike, ones: PyTree, others: PyTree) -> PyTree:
    """Returns the numbers of one tree where a condition holds, else of another."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), ones, others)


def largest(tree: PyTree) -> Array:
    """Returns the size of the largest number in a tree."""
    sizes = [jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]
    return functools.reduce(jnp.maximum, sizes)


def is_singular(health: Health) -> Array:
    return functools.reduce(operator.or_, (x == 0 for x in health))


def health_if(finite: Array, health: Health) -> Health:
    """Returns the health, NaN where rates are not finite unless they are singular."""
    return tuple(jnp.where(finite | (x == 0), x, jnp.nan) for x in health)


class Estimate(NamedTuple):
    """The error of a step as controllers get it, and what is known of its end.

    - `health`: the `Health` there, 1 if that is bad.
    - `scheduled`: what depends on time alone there, None where that is not known.
    """

    error: PyTree
    health: Health
    scheduled: PyTree = None


def scheduled_at_end(schedule: PyTree) -> PyTree:
    """Returns the row of a step's schedule for its `Estimate`."""
    return jax.tree.map(lambda rows: rows[AT_END], schedule)


def verdict(estimate: Estimate, h: Array) -> tuple[Estimate, diffrax.RESULTS]:
    """Returns an estimate, its error and health replaced if that is bad, and a result.

    The health is NaN for a step that is not finite, and 0 for a singular one. An
    infinite error rejects the step until it is short. Results of rejected steps are
    ignored, so the short step is accepted, with error 0.
    """
    error, health, scheduled = estimate
    singular, short = is_singular(health), jnp.abs(h) < SHORTEST[h.dtype]
    bad = singular | jnp.isnan(sum(health))
    results: Any = diffrax.RESULTS
    kind = results.where(singular, results.singular, results.nonfinite)
    result = results.where(bad & short, kind, results.successful)
    imposed = jnp.where(short, 0, jnp.inf)
    error = jax.tree.map(lambda e: jnp.where(bad, imposed, e), error)
    health = tuple(jnp.where(bad, 1, x) for x in health)
    return Estimate(error, health, scheduled), result
