"""The step controller of integrations, around one of diffrax.

It does not chase rounding errors. Equations that lose accuracy amplify them in the
rates. The error estimate of a step is then this noise times the step size: no shorter
step brings it below a tight tolerance, and steps that try reach nothing.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

from ..linkage.topology import real_joints
from .controllers import Adaptive, Judging
from .derivative_control import OfLinearised, OfTangents, Step
from .dopri8 import (
    Arguments,
    Estimate,
    Health,
    Integrated,
    ScheduledTerm,
    chosen,
    constant,
    health_if,
    is_singular,
    largest,
    verdict,
    with_change,
)
from .landing import Landing, NextStep
from .switching import in_force, motion_of

# Rounding errors of an acceleration, over its size times eps and the loss of accuracy:
# less for slides, whose inertia is a sum of masses without levers.
_OF_REVOLUTE, _OF_SLIDE = 1.0, 0.5
# An error estimate sums the noise of all stages: below so many rounding errors it
# neither rejects a step nor shortens the next.
_NOISE = 8.0
# Of the rounding error, or of the tolerance if that is larger: noise beyond this part
# leaves the next step as long, and less noise lets it be longer.
_HELD = 0.43


class _State(NamedTuple):
    inner: PyTree  # of diffrax's controller
    landing: PyTree  # of `Landing`
    probe: Array | tuple[()] | None  # of derivatives
    loss: Array  # the largest loss of accuracy in steps so far


class StepControl(Adaptive):
    """Judges the steps of an integration, and ends them where something happens.

    `controller` is one of diffrax that judges errors. After each step, in this order:

    | question | if so |
    |---|---|
    | Is its end singular, or not finite? | a shorter step; once that is tiny, the end |
    | Would derivatives be less accurate than the tolerance? | a larger error |
    | Is its error only rounding? | it counts as 0: shorter steps have it, too |
    | Is the error within the tolerance? | `controller` keeps or rejects the step |
    | Did it pass a known time or a switch? | a step that ends there (see `Landing`) |
    | How much accuracy did it lose? | recorded, for `Solution.stats` |

    Up to the tolerance, a motion does not depend on where its steps end. So lengths of
    steps are constants in derivatives, except where steps end at known times.

    - `term`: the equations; None if rates are trusted and no error is mere rounding.
    - `watches`: whether this controller, not the solver, checks the ends of steps.
    """

    controller: Any
    term: ScheduledTerm | None
    watches: bool = eqx.field(static=True)
    landing: Landing | None
    derivatives: OfTangents | OfLinearised | None

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):  # pyright: ignore[reportIncompatibleMethodOverride]
        arguments = constant((terms, t0, t1, motion_of(y0), dt0, in_force(args, y0)))
        first, inner = constant(self.controller.init(*arguments, func, error_order))
        probe = None if self.derivatives is None else self.derivatives.start(y0)
        loss, landing = jnp.zeros_like(first), None
        if self.landing is not None:
            first, landing = self.landing.start(t0, t1, first)
        return first, _State(inner, landing, probe, loss)

    def adapt_step_size(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t0, t1, y0, y1, args, y_error, error_order, state
    ):
        # Is its end singular, or not finite?
        health_result = diffrax.RESULTS.successful
        if self.watches:
            y1, y_error, health_result = self._healthy(t0, t1, y0, y1, args, y_error)
        # Would derivatives be less accurate than the tolerance?
        ratio, probe = None, None
        if self.derivatives is not None:
            taken = Step(t0, t1, y0, y1, args)
            ratio, probe = self.derivatives(taken, y_error, state.probe, self.rtol)
        judged: Any = *map(motion_of, (y0, y1)), with_change(y_error, motion_of)
        controller = self.controller
        before, after, error = constant(judged)
        begin, end, args = constant((t0, t1, args))
        # Is its error only rounding? How much accuracy did it lose?
        loss = state.loss
        if self.term is not None:
            loss = functools.reduce(jnp.maximum, error.health, loss)
            error = _above_rounding(
                controller, end - begin, before, after, args, error, ratio, error_order
            )
        # Is the error within the tolerance?
        keep, next0, next1, jumped, inner, result = constant(
            controller.adapt_step_size(
                begin, end, before, after, args, error, error_order, state.inner
            )
        )
        # Did it pass a known time or a switch?
        step, landing = NextStep(keep, next0, next1, jumped, result), None
        if self.landing is not None:
            step, resumes, landing = self.landing.after(t0, t1, y1, step, state.landing)
            inner = chosen(resumes, state.inner, inner)
        if self.derivatives is not None:
            probe = chosen(jnp.array(step.jumped), self.derivatives.start(y1), probe)
            probe = chosen(step.keep, probe, state.probe)
        loss = jnp.where(step.keep, loss, state.loss)
        failed = health_result != diffrax.RESULTS.successful
        result = diffrax.RESULTS.where(failed, health_result, step.result)
        return *step[:4], _State(inner, landing, probe, loss), result

    def _healthy(
        self, t0: Array, t1: Array, y0: Integrated, y1: Integrated, args: Arguments,
        error: PyTree,
    ) -> tuple[Integrated, Estimate, diffrax.RESULTS]:  # fmt: skip
        """Returns a finite end, the error and health of a step, and its result."""
        assert self.term is not None
        # Rates that are not finite make the error not finite.
        finite = jnp.isfinite(sum(map(jnp.sum, jax.tree.leaves((y1, error)))))
        # If the end is not finite, the health at the start shows why.
        end = chosen(finite, y1, y0)
        health: Health = self.term.health(*constant((t1, end, args)))
        health = health_if(finite, health)
        bad = jnp.isnan(sum(health)) | is_singular(health)
        estimate, failure = verdict(Estimate(error, health), t1 - t0)
        # The error is scaled by the state, which must be finite for that.
        return chosen(bad, y0, y1), estimate, failure


def largest_loss(controller_state: PyTree) -> Array:
    """Returns the largest loss of accuracy in a solve, from its controllers' state."""
    mine = lambda node: isinstance(node, _State)
    (state,) = filter(mine, jax.tree.leaves(controller_state, is_leaf=mine))
    return state.loss


def _above_rounding(
    control: Judging,
    h: Array,
    y0: Integrated,
    y1: Integrated,
    args: Arguments,
    estimate: Estimate,
    of_derivatives: Array | None,
    order: float | None,
) -> PyTree:
    """Returns the error of a step of length `h` without what is rounding.

    `of_derivatives`: the error of derivatives over their tolerance, which counts too.
    """
    error, health, _ = estimate
    same_step = _same_step(control, order)
    of_qd = _rounding(real_joints(args.linkage.ef), health, y0, y1)
    of_delta = jax.tree.map(lambda noise: jnp.abs(h) * noise, of_qd)

    def judged(error: Array, start: Array, end: Array, rounding: Array) -> Array:
        size = jnp.maximum(jnp.abs(start), jnp.abs(end))
        tolerance = control.atol + control.rtol * size  # as diffrax's controller has it
        out_of_reach, error_size = rounding > tolerance, jnp.abs(error)
        ratio = error_size / jnp.where(out_of_reach, rounding, tolerance)
        is_noise = error_size < _NOISE * rounding
        as_long = same_step * jnp.minimum(ratio / _HELD, 1)
        above_noise = ratio / jnp.where(out_of_reach, _NOISE, 1)
        judged_as = tolerance * jnp.where(is_noise, as_long, above_noise)
        error = jnp.where(out_of_reach | is_noise, judged_as, error)
        if of_derivatives is None:
            return error
        # A step that is not finite has no tolerance, and an infinite error.
        return jnp.fmax(jnp.abs(error), of_derivatives * tolerance)

    # The elements' own states come last; their rates do not lose accuracy.
    motion = jax.tree.map(judged, error[:2], y0[:2], y1[:2], (of_delta, of_qd))
    return *motion, *error[2:]


def _same_step(controller: Judging, order: ArrayLike | None) -> ArrayLike:
    """Returns the error, over its tolerance, after which the next step is as long."""
    if not isinstance(controller, diffrax.PIDController):
        return _HELD  # what a method of order 8 has with diffrax's safety factor
    if controller.error_order is not None:
        order = controller.error_order
    # Without an order the controller raises an error of its own.
    return _HELD if order is None else controller.safety**order


def _rounding(
    revolute: Sequence[Array], health: Health, y0: Integrated, y1: Integrated
) -> PyTree:
    """Estimates the rounding errors of a step in each velocity or momentum.

    A velocity changes by its acceleration, and its direction turns with the links.
    Joints that lose accuracy disturb those that do not.
    """
    joints: PyTree = tuple(revolute), health
    if eqx.is_array(y0[1]):
        joints = tuple(map(jnp.stack, joints))
    revolute, losses = joints
    shift, change = jax.tree.map(lambda a, b: jnp.abs(b - a), y0[:2], y1[:2])
    turned = jax.tree.map(lambda r, step: jnp.where(r, step, 0), revolute, shift)
    turned = sum(map(jnp.sum, jax.tree.leaves(turned)))
    size = jnp.maximum(largest(change), turned * largest(y0[1]))
    worst = jnp.finfo(size.dtype).eps * jnp.sqrt(largest(losses)) * size

    def noise(revolute: Array, loss: Array) -> Array:
        return jnp.where(revolute, _OF_REVOLUTE, _OF_SLIDE) * jnp.sqrt(loss) * worst

    return jax.tree.map(noise, revolute, losses)
