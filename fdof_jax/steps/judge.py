"""Judges steps: whether they are accurate, and how long the next one may be.

It does not chase rounding errors: where equations lose accuracy, no shorter step meets
a tight tolerance.
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

from ..base.trees import chosen, constant, largest
from ..linkage.topology import real_joints
from .derivative_control import ProbeJudge, StepEnds, TangentJudge
from .dopri8 import Estimate, verdict
from .landing import NextStep
from .term import Health, Integrated, ScheduledTerm, health_if, is_singular
from .tolerances import ErrorControl

# Rounding errors of an acceleration, over its size times eps and the loss of accuracy:
# less for slides, whose inertia is a sum of masses without levers.
_OF_REVOLUTE, _OF_SLIDE = 1.0, 0.5
# An error estimate sums the noise of all stages: below so many rounding errors it
# neither rejects a step nor shortens the next.
_NOISE = 8.0
# Of the rounding error, or of the tolerance if that is larger: noise beyond this part
# leaves the next step as long, and less noise lets it be longer.
_HELD = 0.43


class JudgeState(NamedTuple):
    """The states of the controller and the probe, and the largest loss so far."""

    controller: PyTree
    probe: PyTree
    loss: Array


class Judge(eqx.Module):
    """Judges the steps of a run, by more than their errors.

    `controller` is one of diffrax that judges errors. After each step, in this order:

    | question | if so |
    |---|---|
    | Is its end singular, or not finite? | a shorter step; once that is tiny, the end |
    | Would derivatives be less accurate than the tolerance? | a larger error |
    | Is its error only rounding? | it counts as 0: shorter steps have it, too |
    | Is the error within the tolerance? | `controller` keeps or rejects the step |
    | How much accuracy did it lose? | recorded |

    Up to the tolerance, a motion does not depend on where its steps end. So lengths of
    steps are constants in derivatives, except at known times.

    - `watches`: whether this judge, not the method, checks ends of steps.
    """

    controller: Any
    term: ScheduledTerm
    watches: bool = eqx.field(static=True)
    derivatives: TangentJudge | ProbeJudge | None

    def start(self, run: tuple, y0: Integrated) -> tuple[Array, JudgeState]:
        """Returns the end of the first step, and the state of the judge."""
        end, controller = constant(self.controller.wrap(1).init(*run))
        probe = () if self.derivatives is None else self.derivatives.start(y0)
        return end, JudgeState(controller, probe, jnp.zeros_like(end))

    def __call__(
        self, step: StepEnds, error: PyTree, order: float, before: JudgeState
    ) -> tuple[NextStep, JudgeState, diffrax.RESULTS]:
        """Returns the planned next step, the state after this one, and its result."""
        controller, probe, loss = before
        # Is its end singular, or not finite?
        health = diffrax.RESULTS.successful
        if self.watches:
            step, error, health = self._healthy(step, error)
        error = error._replace(error=without_nan(error.error))
        # Would derivatives be less accurate than the tolerance?
        ratio = None
        if self.derivatives is not None:
            ratio, probe = self.derivatives(step, error, probe, self.controller.rtol)
        step, error = constant((step, error))
        # Is its error only rounding? How much accuracy did it lose?
        loss = functools.reduce(jnp.maximum, error.health, loss)
        error = _above_rounding(self.controller, step, error, ratio, order)
        # Is the error within the tolerance?
        *plan, controller, result = constant(
            self.controller.wrap(1).adapt_step_size(*step, error, order, controller)
        )
        return NextStep(*plan, result), JudgeState(controller, probe, loss), health  # pyright: ignore[reportCallIssue]

    def before_next(
        self, after: JudgeState, before: JudgeState, step: NextStep, resumes: Array,
        y1: Integrated,
    ) -> JudgeState:  # fmt: skip
        """Returns the state of the judge before the next step.

        `after`, `before`: those at the ends of this step; `y1`: its end; `resumes`:
        whether the controller keeps its old state.
        """
        controller, probe, loss = after
        if self.derivatives is not None:
            new = self.derivatives.start(y1)
            probe = chosen(jnp.array(step.jumped), new, probe)
        return JudgeState(
            chosen(resumes, before.controller, controller),
            chosen(step.keep, probe, before.probe),
            jnp.where(step.keep, loss, before.loss),
        )

    def _healthy(
        self, step: StepEnds, error: PyTree
    ) -> tuple[StepEnds, Estimate, diffrax.RESULTS]:
        """Returns a finite end, the error and health of a step, and its result."""
        t0, t1, y0, y1, args = step
        # Rates that are not finite make the error not finite.
        finite = jnp.isfinite(sum(map(jnp.sum, jax.tree.leaves((y1, error)))))
        # If the end is not finite, the health at the start shows why.
        end = chosen(finite, y1, y0)
        health: Health = self.term.health(*constant((t1, end, args)))
        health = health_if(finite, health)
        bad = jnp.isnan(sum(health)) | is_singular(health)
        estimate, failure = verdict(Estimate(error, health), t1 - t0)
        # The error is scaled by the state, which must be finite for that.
        return step._replace(y1=chosen(bad, y0, y1)), estimate, failure


def without_nan(error: PyTree) -> PyTree:
    """Returns an error with infinity for what is not a number.

    Stages of a long step may overflow; diffrax's controllers would find no next length.
    """
    return jax.tree.map(lambda e: jnp.where(jnp.isnan(e), jnp.inf, e), error)


def _above_rounding(
    control: ErrorControl,
    step: StepEnds,
    estimate: Estimate,
    of_derivatives: Array | None,
    order: float | None,
) -> PyTree:
    """Returns the error of a step without rounding, but with that of derivatives."""
    error, health, _ = estimate
    t0, t1, y0, y1, args = step
    same_step = _same_step(control, order)
    of_qd = _rounding(real_joints(args.linkage.ef), health, y0, y1)
    of_delta = jax.tree.map(lambda noise: jnp.abs(t1 - t0) * noise, of_qd)

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


def _same_step(controller: ErrorControl, order: ArrayLike | None) -> ArrayLike:
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
    """Estimates the rounding errors of a step in each velocity.

    A velocity changes by its acceleration, and its direction turns with the links.
    Joints that lose accuracy disturb the others.
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
