"""Step size controllers: own ones, the default, tolerances, and changes of any."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from ..base.checks import concrete, instance, is_traced, real_array, real_numbers
from ..base.user_warnings import warn
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage, check_linkage, joints_of
from ..linkage.topology import real_joints
from .dopri8 import Integrated, constant

Controller = diffrax.AbstractStepSizeController
Judging = diffrax.AbstractAdaptiveStepSizeController  # judges errors of steps
_C = TypeVar("_C", bound=Controller)
_T = TypeVar("_T")
# Default tolerances in float64 and float32, relative and absolute.
TOLERANCE, SINGLE_TOLERANCE = 1e-11, 1e-5
# Rounding keeps float32 from meeting a tighter relative or absolute tolerance.
_TIGHTEST_SINGLE = 1e-6


def giving_up(
    result: diffrax.RESULTS, spent: Array, reason: diffrax.RESULTS
) -> diffrax.RESULTS:
    """Returns `reason` if `spent`, unless the step has failed by itself."""
    ends = spent & (result == diffrax.RESULTS.successful)
    return diffrax.RESULTS.where(ends, reason, result)


def _with(
    change: Callable[..., Controller],
    controller: _C,
    concerns: Callable[[object], bool],
) -> _C:
    """Returns a controller with `change` applied where `concerns` is true."""
    return jax.tree.map(
        lambda node: change(node) if concerns(node) else node,
        controller,
        is_leaf=concerns,
    )


def with_pid(
    change: Callable[[diffrax.PIDController], Controller], controller: _C
) -> _C:
    """Returns a controller with `change` applied to the PID controllers in it."""
    return _with(change, controller, lambda n: isinstance(n, diffrax.PIDController))


def with_error_control(change: Callable[..., Controller], controller: _C) -> _C:
    """Returns a controller with `change` applied to the one that judges errors."""

    def judges(node: object) -> bool:
        wrapper = isinstance(node, Abreast | diffrax.ClipStepSizeController)
        return isinstance(node, Judging) and not wrapper

    return _with(change, controller, judges)


def by_square_roots(controller: Controller) -> Controller:
    """Returns a controller for methods of order 8: the same steps, without powers.

    A step changes by the eighth root of its error. XLA on CPU calls the C library's
    `pow` for each lane, but square roots are vectorised: a sweep takes 4 % less time.
    """

    def without_powers(pid: diffrax.PIDController) -> diffrax.PIDController:
        used = pid.pcoeff, pid.icoeff, pid.dcoeff, pid.error_order
        plain = all(isinstance(number, int | float | None) for number in used)
        # Subclasses of a user may have another formula.
        diffrax_rule = type(pid) in (diffrax.PIDController, Shortening)
        if not (diffrax_rule and plain and used == (0, 1, 0, None)):
            return pid

        def norm(error: PyTree) -> Array:
            return jnp.sqrt(jnp.sqrt(jnp.sqrt(pid.norm(error))))

        return dataclasses.replace(pid, icoeff=8.0, norm=norm)

    return with_pid(without_powers, controller)


class Shortening(diffrax.PIDController):
    """An integral controller that may shorten the next step even after one it keeps.

    After a step that it keeps, diffrax's controller never takes a shorter one, even if
    the error has come close to the tolerance: the next step is then often rejected. In
    a batch of Fig 5 that is every fifth step.
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


class Adaptive(Judging):
    """Wrapper of an adaptive controller; implicit solvers read its tolerances.

    The arguments of `init` and `adapt_step_size` are those of diffrax.
    """

    controller: eqx.AbstractVar[Any]

    def wrap(self, direction):
        inner = self.controller.wrap(direction)
        return eqx.tree_at(lambda c: c.controller, self, inner)

    def init(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.init(*arguments)

    def adapt_step_size(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.adapt_step_size(*arguments)

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


class Scaled(Adaptive):
    """A controller that measures each coordinate in a unit of its own.

    `StepControl` scales what it gets.
    """

    controller: Judging
    unit: tuple[Array, Array]  # of q and of qd (n,)

    def init(self, *arguments):
        if arguments[4] is None:
            raise ValueError(
                "dt0: expected a first step [s] with scaled tolerances, got None."
            )
        return super().init(*arguments)

    def scaled(self, state: Integrated) -> Integrated:
        """Returns a state in these units; the elements' own states keep theirs."""
        scalars = isinstance(state[0], tuple)
        units: PyTree = tuple(map(tuple, self.unit)) if scalars else self.unit
        return (*jax.tree.map(jnp.divide, state[:2], units), *state[2:])


# A lane stops once it has taken `_SLACK` times as many steps as it had taken when
# `_MOST` of the lanes were done.
_SLACK, _MOST = 1.5, 7 / 8


class Abreast(Adaptive):
    """A step size controller that gives up when most other lanes are long done.

    For programs that are mapped over a named axis. The result is then
    `max_steps_reached`, before diffrax's own `max_steps`.
    """

    controller: Judging
    axis: str = eqx.field(static=True)

    def init(self, *arguments):
        first, state = super().init(*arguments)
        none = jnp.zeros((), jnp.int32)
        return first, (state, none, none)

    def adapt_step_size(self, *arguments):
        *arguments, (state, count, typical) = arguments
        *step, state, result = super().adapt_step_size(*arguments, state)
        count = count + 1
        # Once a lane is done its state is frozen, so that its count falls behind.
        done = count < jax.lax.pmax(count, self.axis)
        most = jax.lax.pmean(done.astype(float), self.axis) >= _MOST
        typical = jnp.where(most & (typical == 0), count, typical)
        behind_most = (typical > 0) & (count >= _SLACK * typical)
        result = giving_up(result, behind_most, diffrax.RESULTS.max_steps_reached)
        return *step, (state, count, typical), result


def of_precision(double: _T, single: _T) -> _T:
    """Returns what serves the precision that JAX has now."""
    return double if jnp.result_type(float) == jnp.float64 else single


def _shortest_step() -> float:
    """Returns the step that ends solves that rounding keeps from their tolerance."""
    return of_precision(1e-13, 1e-8)


def adaptive(
    rtol: float | Array | np.ndarray, atol: float | Array | np.ndarray
) -> diffrax.PIDController:
    """Returns a controller with a relative and an absolute tolerance."""
    shortest = _shortest_step()
    # In float32 the rounding errors of stiff forces, which nothing estimates, are not
    # far below usual tolerances; to shorten steps after them would be to chase them.
    kind = of_precision(Shortening, diffrax.PIDController)
    return kind(rtol, atol, dtmin=shortest, force_dtmin=False)


def _default_tolerance() -> float:
    return of_precision(TOLERANCE, SINGLE_TOLERANCE)


def default_controller() -> diffrax.PIDController:
    """Returns the default controller of `simulate` and `sweep`."""
    return adaptive(_default_tolerance(), _default_tolerance())


def at_tolerances(
    rtol: ArrayLike | None, atol: ArrayLike | None
) -> diffrax.PIDController:
    """Returns the default controller with other tolerances; None keeps one."""
    known = isinstance(rtol, float | None) and isinstance(atol, float | None)
    make = _at_known_tolerances if known else _at_tolerances
    return make(rtol, atol, jnp.result_type(float))


def _at_tolerances(
    rtol: ArrayLike | None, atol: ArrayLike | None, dtype: np.dtype
) -> diffrax.PIDController:
    del dtype  # that of the tolerances, a part of the cache's key
    default = _default_tolerance()
    return adaptive(
        _number("rtol", default if rtol is None else rtol),
        _number("atol", default if atol is None else atol),
    )


# Of a sweep of 16 arms, in 1.0 ms, another controller would take 0.15 ms.
_at_known_tolerances: Any = functools.lru_cache(_at_tolerances)


def _number(name: str, value: ArrayLike) -> Array | np.ndarray:
    """Returns a positive number as an array, of which new values need no new trace."""
    number = real_numbers(name, value, (), above=0)
    # Else a derivative with respect to it would fail later, without this name.
    traced = is_traced(number)
    return eqx.internal.nondifferentiable(number, name=name) if traced else number


def with_longest(controller: Any, max_step: ArrayLike) -> Controller:
    """Returns the controller with a longest step [s]."""
    longest = _number("max_step", max_step)
    return with_pid(lambda pid: dataclasses.replace(pid, dtmax=longest), controller)


def within_reach(controller: Controller) -> Controller:
    """Returns the controller with a shortest step, which ends solves that are stuck.

    In float32, tolerances that cannot be met are raised, with a warning.
    """
    x64 = jnp.result_type(float) == jnp.float64

    def with_limits(pid: diffrax.PIDController) -> diffrax.PIDController:
        if pid.dtmin is None:
            shortest = _shortest_step()
            pid = dataclasses.replace(pid, dtmin=shortest, force_dtmin=False)
        if x64:
            return pid
        rtol, atol = met(pid.rtol, "rtol"), met(pid.atol, "atol")
        return dataclasses.replace(pid, rtol=rtol, atol=atol)

    def met(tolerance: ArrayLike, name: str) -> ArrayLike:
        value = concrete(tolerance)
        if value is None or value >= _TIGHTEST_SINGLE / 2:
            return tolerance
        warn(
            f"stepsize_controller: {name}={value:g} cannot be met in float32, "
            f"{_TIGHTEST_SINGLE:g} is used; fj.configure(x64=True) allows more."
        )
        return _TIGHTEST_SINGLE

    return with_pid(with_limits, controller)


def scale_tolerances(
    linkage: Linkage,
    controller: diffrax.AbstractAdaptiveStepSizeController | None = None,
    *,
    scale: State | None = None,
) -> diffrax.AbstractAdaptiveStepSizeController:
    """Returns a controller whose absolute tolerance scales with the linkage.

    By default an absolute tolerance of 1e-11 is in metres, radians and their rates. For
    an arm of millimetres or kilometres, pass the result as `stepsize_controller`. Its
    unit of slides is the size L of the arm [m], its unit of time is sqrt(L/g) [s], and
    angles stay in radians.

    **Arguments:**

    - `controller`: the controller to scale; by default that of `simulate`.
    - `scale`: other units per coordinate, a State of two positive arrays (n,)
      [m or rad, m/s or rad/s].

    **Raises:** ValueError for a controller that is not adaptive, a scale that is not
    positive, or a linkage of no size without `scale`.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> controller = fj.simulation.scale_tolerances(arm)
    >>> [float(unit) for unit in controller.unit[1]]  # of rates: 1 / sqrt(L/g) [1/s]
    [1.279, 1.279, 1.279]
    """
    check_linkage(linkage)
    controller = default_controller() if controller is None else controller
    instance("controller", controller, diffrax.AbstractAdaptiveStepSizeController)
    if scale is not None:
        instance("scale", scale, State)
        q, qd = (
            real_array(f"scale.{name}", value, (joints_of(linkage),), above=0)
            for name, value in zip(State._fields, scale)
        )
    else:
        size = jnp.sum(jnp.abs(linkage.length)) + jnp.sum(jnp.abs(linkage.com))
        if concrete(size) == 0:
            raise ValueError("scale: expected one, as the linkage has no size.")
        time = jnp.where(
            linkage.gravity == 0, 1, jnp.sqrt(size / jnp.abs(linkage.gravity))
        )
        q = jnp.where(jnp.stack(real_joints(linkage.ef)), 1, size)
        qd = q / time
    return with_error_control(lambda c: Scaled(c, (q, qd)), controller)  # pyright: ignore[reportCallIssue]
