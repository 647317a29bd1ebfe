"""Tolerances of steps, and controllers for them."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar, get_origin

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from ..base.checks import concrete, is_traced, real_numbers, refusal
from ..base.trees import constant
from ..base.user_warnings import warn
from .term import ScheduledTerm

Controller = diffrax.AbstractStepSizeController
ErrorControl = diffrax.AbstractAdaptiveStepSizeController
# What stands for tolerances of implicit methods that are those of the controller.
_OF_CONTROLLER = diffrax.with_stepsize_controller_tols(diffrax.VeryChord)().rtol
_C = TypeVar("_C", bound=Controller)
_T = TypeVar("_T")
# Default tolerances in float64 and float32, relative and absolute.
TOLERANCE, SINGLE_TOLERANCE = 1e-11, 1e-5
# Rounding keeps float32 from meeting a tighter relative or absolute tolerance.
_TIGHTEST_SINGLE = 1e-6


def _with(
    change: Callable[..., Controller],
    controller: _C,
    concerns: Callable[[object], bool],
) -> _C:
    """Applies `change` in a controller where `concerns` is true."""
    return jax.tree.map(
        lambda node: change(node) if concerns(node) else node,
        controller,
        is_leaf=concerns,
    )


def with_pid(
    change: Callable[[diffrax.PIDController], Controller], controller: _C
) -> _C:
    """Applies `change` to the PID controllers in a controller."""
    return _with(change, controller, lambda n: isinstance(n, diffrax.PIDController))


def _controls_errors(node: object) -> bool:
    """Returns whether a node judges errors itself."""
    wraps = isinstance(node, diffrax.ClipStepSizeController)
    return isinstance(node, ErrorControl) and not wraps


def with_error_control(change: Callable[..., Controller], controller: _C) -> _C:
    return _with(change, controller, _controls_errors)


def error_control_of(controller: Controller) -> ErrorControl:
    nodes = jax.tree.leaves(controller, is_leaf=_controls_errors)
    return next(filter(_controls_errors, nodes))


def check_method(method: diffrax.AbstractSolver) -> None:
    """Raises ValueError for a method of other equations, such as stochastic ones."""
    structure = method.term_structure
    kind = get_origin(structure) or structure
    if not (isinstance(kind, type) and issubclass(ScheduledTerm, kind)):
        expected = "one of ordinary differential equations (diffrax.ODETerm)"
        raise refusal("solver", expected, method)


def with_tolerances(
    method: diffrax.AbstractSolver, controller: Controller
) -> diffrax.AbstractSolver:
    """Returns a method that solves equations to the tolerances of a controller.

    Implicit methods of diffrax do so by default. Raises ValueError if there are none.
    """
    if not isinstance(method, diffrax.AbstractImplicitSolver):
        return method
    names = [
        name
        for name in ("rtol", "atol", "norm")
        if getattr(method.root_finder, name) is _OF_CONTROLLER
    ]
    if not names:
        return method
    if not isinstance(controller, ErrorControl):
        raise refusal(
            "stepsize_controller",
            "an adaptive one, as the root finder of an implicit solver has no "
            "tolerances of its own",
            controller,
        )
    return eqx.tree_at(
        lambda method: [getattr(method.root_finder, name) for name in names],
        method,
        [getattr(controller, name) for name in names],
    )


def by_square_roots(controller: Controller) -> Controller:
    """Returns a controller for methods of order 8: the same steps, without powers.

    A step changes by the eighth root of its error; XLA on CPU vectorises square roots,
    but no powers.
    """

    def without_powers(pid: diffrax.PIDController) -> diffrax.PIDController:
        used = pid.pcoeff, pid.icoeff, pid.dcoeff, pid.error_order
        plain = all(isinstance(number, int | float | None) for number in used)
        # Subclasses of a user may have another formula.
        diffrax_rule = type(pid) in (diffrax.PIDController, EagerController)
        if not (diffrax_rule and plain and used == (0, 1, 0, None)):
            return pid

        def norm(error: PyTree) -> Array:
            return jnp.sqrt(jnp.sqrt(jnp.sqrt(pid.norm(error))))

        return dataclasses.replace(pid, icoeff=8.0, norm=norm)

    return with_pid(without_powers, controller)


class EagerController(diffrax.PIDController):
    """An integral controller that may shorten the next step even after one it keeps.

    diffrax's never does, and its next step is then often rejected.
    """

    safety: float = 0.8  # pyright: ignore[reportIncompatibleVariableOverride]

    def adapt_step_size(self, t0, t1, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        keep, next_t0, next_t1, *rest, state, result = super().adapt_step_size(
            t0, t1, *arguments
        )
        order, _ = arguments[-2:]
        inverse_error, *_ = state  # of a step that is kept; 1 stands for no error
        factor = constant(self.safety * inverse_error ** (self.icoeff / order))
        shorter = (t1 - t0) * jnp.maximum(factor, self.factormin)
        if self.dtmin is not None:
            shorter = jnp.maximum(shorter, self.dtmin)
        shortened = keep & (factor < 1) & (inverse_error != 1)
        next_t1 = jnp.where(shortened, next_t0 + shorter, next_t1)
        return keep, next_t0, next_t1, *rest, state, result


def of_precision(double: _T, single: _T) -> _T:
    """Returns what serves the current precision of JAX."""
    return double if jnp.result_type(float) == jnp.float64 else single


def _shortest_step() -> float:
    """Returns the step that ends solves that rounding keeps from their tolerance."""
    return of_precision(1e-13, 1e-8)


def adaptive(
    rtol: float | Array | np.ndarray, atol: float | Array | np.ndarray
) -> diffrax.PIDController:
    shortest = _shortest_step()
    # In float32 the rounding errors of stiff forces, which nothing estimates, are not
    # far below usual tolerances; to shorten steps after them would be to chase them.
    kind = of_precision(EagerController, diffrax.PIDController)
    return kind(rtol, atol, dtmin=shortest, force_dtmin=False)


def _default_tolerance() -> float:
    return of_precision(TOLERANCE, SINGLE_TOLERANCE)


def default_controller() -> diffrax.PIDController:
    return adaptive(_default_tolerance(), _default_tolerance())


def at_tolerances(
    rtol: ArrayLike | None, atol: ArrayLike | None
) -> diffrax.PIDController:
    """Returns the default controller with other tolerances; None keeps one."""
    default = _default_tolerance()
    return adaptive(
        _number("rtol", default if rtol is None else rtol),
        _number("atol", default if atol is None else atol),
    )


def _number(name: str, value: ArrayLike) -> Array | np.ndarray:
    """Returns a positive number as an array, whose new values need no new trace."""
    number = real_numbers(name, value, (), above=0)
    # Else a derivative with respect to it would fail later, without this name.
    traced = is_traced(number)
    return eqx.internal.nondifferentiable(number, name=name) if traced else number


def with_longest(controller: Any, max_step: ArrayLike) -> Controller:
    longest = _number("max_step", max_step)
    return with_pid(lambda pid: dataclasses.replace(pid, dtmax=longest), controller)


def within_reach(controller: Controller) -> Controller:
    """Returns the controller with a shortest step, which ends solves that are stuck.

    In float32, warns of tolerances that cannot be met.
    """

    def with_shortest(pid: diffrax.PIDController) -> diffrax.PIDController:
        for name, tolerance in {"rtol": pid.rtol, "atol": pid.atol}.items():
            value = concrete(tolerance)
            if value is not None and value < of_precision(0, _TIGHTEST_SINGLE / 2):
                warn(
                    f"stepsize_controller: {name}={value:g} cannot be met in float32; "
                    "fj.configure(x64=True) allows more."
                )
        if pid.dtmin is not None:
            return pid
        return dataclasses.replace(pid, dtmin=_shortest_step(), force_dtmin=False)

    return with_pid(with_shortest, controller)
