"""Step control of derivatives: their errors count beside those of the motion.

A motion at rest has no error, but its derivatives have. `TangentJudge` judges tangents;
where these are unknown, `ProbeJudge` judges a probe.
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from ..base.trees import constant, largest
from .dopri8 import Estimate, lower_triangle
from .term import Arguments, Health, Integrated, ScheduledTerm

# The relative tolerance of tangents: over that of the motion, its upper limit, and its
# lower limit in rounding errors.
_LOOSER, _LOOSEST, _NOISE = 2e3, 1e-5, 64.0
# That of a probe, whatever the motion's: undamped tangents are right to 3e-7 after 1000
# rad, and those of stops and slides at rest to 1e-6.
_OF_PROBE = 3e-9
_GROWN = 1e3  # size of a probe that is replaced by a new one, of size 1
# A tangent below this part of the largest one is judged as if it were as large.
_WEAK = 0.1
# No tangent has a tolerance of more than so many times that of one which is large; in
# sums of squares, for instance, it may.
_LEAST, _ANY = 30.0, 1e9
TANGENTS = "tangents"  # the name of their axis


def _noise(health: Health) -> Array:
    """Returns the relative rounding error of tangents."""
    loss = constant(jnp.max(jnp.stack(health)))
    return _NOISE * jnp.finfo(loss.dtype).eps * loss


@jax.custom_jvp
def _error_of_tangents(
    error: PyTree, ends: PyTree, integrated: PyTree, tolerance: Array, noise: Array,
    least: Array,
) -> Array:  # fmt: skip
    """Returns the largest error of a tangent over its tolerance, 0 without tangents.

    The tangents are those along `TANGENTS`. `ends`, `integrated`: both ends of a step,
    in positions and in displacements. `least`: see `_LEAST`.
    """
    return jnp.zeros_like(tolerance)


@_error_of_tangents.defjvp
def _(primals, tangents):
    _, _, motion, tolerance, noise, least = primals
    error, own, integrated = constant(tuple(map(largest, tangents[:3])))
    size = jnp.maximum(own, _WEAK * jax.lax.pmax(own, TANGENTS))
    # A tangent far smaller than the largest is exact, too.
    allowed = tolerance * jnp.minimum(size, least * own)
    # Terms of a tangent may cancel, and leave rounding errors of the motion.
    allowed += noise * (largest(motion) + integrated)
    ratio = jnp.where(allowed > 0, error / allowed, 0)
    # Shorter steps do not mend a tangent that is not a number.
    ratio = constant(jnp.where(jnp.isnan(ratio), 0, ratio))
    ratio = jax.lax.pmax(ratio, TANGENTS)
    return ratio, jnp.zeros_like(ratio)


class StepEnds(NamedTuple):
    t0: Array
    t1: Array
    y0: Integrated
    y1: Integrated
    args: Arguments


class TangentJudge(eqx.Module):
    """Judges tangents of the motion; all of them take the same steps.

    `tolerance`: relative to the largest tangent, however small others are. None: each
    has its own, from that of the motion.
    """

    tolerance: float | None = None

    def start(self, y0: Integrated) -> tuple[()]:
        return ()

    def __call__(
        self, step: StepEnds, estimate: Estimate, probe: tuple[()], rtol: Array | float
    ) -> tuple[Array, tuple[()]]:
        """Returns the largest error of a tangent over its tolerance, and no probe."""
        noise = _noise(estimate.health)
        tolerance, least = self.tolerance, _ANY
        if tolerance is None:
            tolerance, least = jnp.minimum(_LOOSER * rtol, _LOOSEST), _LEAST
        tolerance = constant(jnp.maximum(tolerance, noise))
        error, *integrated = estimate.error, step.y0, step.y1
        # Tangents of displacements lack that of the start.
        ends = [(step.args.q0 + jnp.stack(q), *others) for q, *others in integrated]
        of_motion = error, ends, integrated
        ratio = _error_of_tangents(*of_motion, tolerance, noise, least)
        return constant(ratio), probe


@eqx.filter_jit  # traced once, not at each use in a solve
def linearised(
    term: ScheduledTerm, t: Array, y: Integrated, args: Arguments, scheduled: PyTree
) -> Array:
    """Returns the Jacobian of the rates in the state's numbers."""
    numbers, state_of = ravel_pytree(y)
    rates = lambda numbers: term.vector_field(t, state_of(numbers), args, scheduled)
    return jax.jacfwd(lambda numbers: ravel_pytree(rates(numbers))[0])(numbers)


class ProbeJudge(eqx.Module):
    """Judges a step by what it does to the linearised motion.

    A probe stands for all tangents. It moves like one, with the linearisation at the
    end of a step held for the whole step. A jump replaces it.
    """

    term: ScheduledTerm
    tableau: diffrax.ButcherTableau = eqx.field(static=True)

    def start(self, y0: Integrated) -> Array:
        numbers, _ = ravel_pytree(y0)
        probe = np.random.default_rng(0).standard_normal(numbers.size)
        return jnp.asarray(probe, numbers.dtype)

    def __call__(
        self, step: StepEnds, estimate: Estimate, probe: Array, rtol: Array | float
    ) -> tuple[Array, Array]:
        """Returns the error of the probe over its tolerance, and the moved probe."""
        t0, t1, _, y1, args = step
        scheduled = estimate.scheduled
        if scheduled is None:
            scheduled = self.term.schedule(t1, args)
        at_end = t1, y1, args, scheduled
        matrix = constant(t1 - t0) * linearised(self.term, *constant(at_end))
        change, error = self._step(matrix, probe)
        end = probe + change
        tolerance = jnp.maximum(_OF_PROBE, _noise(estimate.health))
        size = jnp.maximum(largest(probe), largest(end))
        ratio = largest(error) / (tolerance * size)
        finite = jnp.isfinite(ratio)
        ratio = constant(jnp.where(finite, ratio, 0))
        # A new one shows again what an unstable mode has come to hide.
        new = ~finite | (largest(end) > _GROWN)
        end = end / jnp.minimum(largest(end), 1)
        return ratio, jnp.where(new, self.start(y1), end)

    def _step(self, matrix: Array, probe: Array) -> tuple[Array, Array]:
        """Returns the change of y' = A y in a step of length h, and its error.

        `matrix` is h A, and `probe` is y at the start.
        """
        count, size = len(self.tableau.b_sol), len(probe)
        implicit = self.tableau.a_diagonal is not None
        diagonal = self.tableau.a_diagonal if implicit else np.zeros(count)

        def stage(changes, row):
            index, weights, own = row
            y = probe + jnp.sum(weights[:, None] * changes, axis=0)
            change = jnp.sum(matrix * y[None], axis=1)  # no call of a library
            if implicit:
                change = jnp.linalg.solve(jnp.eye(size) - own * matrix, change)
            return changes.at[index].set(change), None

        numbers = lambda rows: jnp.asarray(rows, probe.dtype)
        rows = (
            jnp.arange(count),
            numbers(lower_triangle(self.tableau)),
            numbers(diagonal),
        )
        changes, _ = jax.lax.scan(stage, jnp.zeros((count, size), probe.dtype), rows)
        whole, error = numbers([self.tableau.b_sol, self.tableau.b_error])
        summed = lambda weights: jnp.sum(weights[:, None] * changes, axis=0)
        return summed(whole), summed(error)
