"""Wrappers of step size controllers, for jumps, bounds and health."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from .dopri8 import constant, verdict


def with_pid(change: Callable[[diffrax.PIDController], Any], controller: Any) -> Any:
    """Returns a controller with `change` applied to the PID controllers in it."""

    def is_pid(node: Any) -> bool:
        return isinstance(node, diffrax.PIDController)

    return jax.tree.map(
        lambda node: change(node) if is_pid(node) else node, controller, is_leaf=is_pid
    )


def bounded(controller: Any, longest: Callable[[], Array]) -> Any:
    """Returns the controller with a longest step, unless it has one."""

    def limited(pid: diffrax.PIDController) -> diffrax.PIDController:
        if pid.dtmax is not None:
            return pid
        return eqx.tree_at(lambda c: c.dtmax, pid, longest(), is_leaf=_is_none)

    return with_pid(limited, controller)


def _is_none(node: Any) -> bool:
    return node is None


def landing_on(
    controller: diffrax.AbstractStepSizeController, jump_ts: Array
) -> diffrax.AbstractStepSizeController:
    """Returns the controller with steps that end at the times where efforts jump.

    Raises ValueError for a controller whose steps are not adaptive.
    """
    if isinstance(controller, Limited):
        return limited(landing_on(controller.controller, jump_ts), controller.limit)
    if not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        raise ValueError(
            "stepsize_controller: expected an adaptive one, as forces declare times "
            f"at which they jump (jump_ts), got {controller!r}."
        )
    return diffrax.ClipStepSizeController(_Longer(controller), jump_ts=jump_ts)  # pyright: ignore[reportCallIssue]


class _Wrapped(diffrax.AbstractStepSizeController):
    """Base class of controllers that wrap another."""

    controller: eqx.AbstractVar[Any]

    def wrap(self, direction):
        inner = self.controller.wrap(direction)
        return eqx.tree_at(lambda c: c.controller, self, inner)


class Adaptive(_Wrapped, diffrax.AbstractAdaptiveStepSizeController):
    """Wrapper of an adaptive controller; implicit solvers read its tolerances."""

    # pyright takes the attributes of the base class for constructor arguments.
    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.norm


class _Longer(Adaptive):
    """A controller that lengthens each step by a factor 1 + sqrt(eps).

    A step over the distance between two jumps would otherwise end a rounding error
    before the second jump, and the next step would be too short to go on.
    """

    controller: Any

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        keep, next_t0, next_t1, *rest = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )
        stretch = 1 + jnp.finfo(next_t1.dtype).eps ** 0.5
        return keep, next_t0, next_t0 + stretch * (next_t1 - next_t0), *rest


def undifferentiated(controller: Any) -> Any:
    """Returns the controller with steps that are constant for derivatives.

    Up to the tolerance, the motion does not depend on where its steps end. Leaving out
    derivatives of the step sizes makes those of the motion cheaper.
    """
    return with_pid(_Undifferentiated, controller)  # pyright: ignore[reportArgumentType]


class _Undifferentiated(Adaptive):
    controller: Any

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return constant(
            self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        )

    def adapt_step_size(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        inputs = constant((t0, t1, y0, y1_candidate, args, y_error))
        step = self.controller.adapt_step_size(*inputs, error_order, controller_state)
        return constant(step)


class Watched(Adaptive):
    """A controller that shortens steps that end in bad health, then gives up.

    It serves solvers that do not check `ScheduledTerm.health` themselves.
    """

    controller: Any
    health: Callable[[Any, Any, Any], Array] = eqx.field(static=True)  # (t, y, args)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        # Rates that are not finite make the error not finite.
        leaves = jax.tree.leaves((y1_candidate, y_error))
        finite = jnp.isfinite(sum(map(jnp.sum, leaves)))
        # If the end is not finite, the health at the start shows why.
        judged = jax.tree.map(lambda a, b: jnp.where(finite, a, b), y1_candidate, y0)
        health = self.health(*constant((t1, judged, args)))
        bad = ~finite | (health == 0)
        imposed, failure = verdict(health == 0, bad, t1 - t0)
        y_error = jax.tree.map(lambda e: jnp.where(bad, imposed, e), y_error)
        # The error is scaled by the state, which must be finite for that.
        end = jax.tree.map(lambda a, b: jnp.where(bad, a, b), y0, y1_candidate)
        *step, result = self.controller.adapt_step_size(
            t0, t1, y0, end, args, y_error, error_order, controller_state
        )
        failed = failure != diffrax.RESULTS.successful
        return *step, diffrax.RESULTS.where(failed, failure, result)


def limited(controller: diffrax.AbstractStepSizeController, limit: Array) -> "Limited":
    """Returns a `Limited` controller, adaptive if the given one is."""
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        return _AdaptiveLimited(controller, limit)  # pyright: ignore[reportCallIssue]
    return Limited(controller, limit)


class Limited(_Wrapped):
    """A step size controller that gives up after a number of steps set at run time.

    diffrax's own `max_steps` is part of the compiled program.
    """

    controller: diffrax.AbstractStepSizeController
    limit: Array

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        first, state = self.controller.init(
            terms, t0, t1, y0, dt0, args, func, error_order
        )
        return first, (state, jnp.zeros_like(self.limit))

    def adapt_step_size(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        inner, count = controller_state
        *step, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        count = count + 1
        spent = (count >= self.limit) & (result == diffrax.RESULTS.successful)
        result = diffrax.RESULTS.where(spent, diffrax.RESULTS.max_steps_reached, result)
        keep, next_t0, next_t1, jump = step
        return keep, next_t0, next_t1, jump, (inner, count), result


class _AdaptiveLimited(Limited, Adaptive):  # pyright: ignore[reportIncompatibleMethodOverride]
    pass
