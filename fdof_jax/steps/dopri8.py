"""Dormand and Prince's method of order 8(7): the common parts of its two solvers."""

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from .term import Health, ScheduledTerm, is_singular

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


class ScheduledDopri8(diffrax.AbstractAdaptiveSolver):
    """Base of both solvers."""

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


class Estimate(NamedTuple):
    """The error of a step for controllers, and what is known of its end.

    - `health`: there, 1 if bad; `scheduled`: what depends on time alone, or None.
    """

    error: PyTree
    health: Health
    scheduled: PyTree = None


def scheduled_at_end(schedule: PyTree) -> PyTree:
    return jax.tree.map(lambda rows: rows[AT_END], schedule)


def verdict(estimate: Estimate, h: Array) -> tuple[Estimate, diffrax.RESULTS]:
    """Returns an estimate, with its error and health replaced if bad, and a result.

    An infinite error rejects a step that is singular or not finite until it is short.
    The short one is accepted, with error 0, as results of rejected steps are ignored.
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
