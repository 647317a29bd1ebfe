"""Tolerances of steps: defaults, limits and units."""

import dataclasses
from typing import Any, TypeVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..base.checks import concrete, instance, is_traced, real_array, real_numbers
from ..base.user_warnings import warn
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage, check_linkage, joints_of
from ..linkage.topology import real_joints
from .controllers import Controller, Scaled, Shortening, with_error_control, with_pid

_T = TypeVar("_T")
# Rounding keeps float32 from meeting a tighter relative or absolute tolerance.
_TIGHTEST_SINGLE = 1e-6


def of_precision(double: _T, single: _T) -> _T:
    """Returns what serves the precision that JAX has now."""
    return double if jnp.result_type(float) == jnp.float64 else single


def _default_tolerance() -> float:
    return of_precision(1e-11, 1e-5)


def _shortest_step() -> float:
    """Returns the step that ends solves that rounding keeps from their tolerance."""
    return of_precision(1e-13, 1e-8)


def adaptive(rtol: ArrayLike, atol: ArrayLike) -> diffrax.PIDController:
    """Returns a controller with a relative and an absolute tolerance."""
    shortest = _shortest_step()
    # In float32 the rounding errors of stiff forces, which nothing estimates, are not
    # far below usual tolerances; to shorten steps after them would be to chase them.
    kind = of_precision(Shortening, diffrax.PIDController)
    return kind(rtol, atol, dtmin=shortest, force_dtmin=False)


def default_controller() -> diffrax.PIDController:
    """Returns the default controller of `simulate` and `sweep`."""
    return adaptive(_default_tolerance(), _default_tolerance())


def at_tolerances(
    rtol: ArrayLike | None, atol: ArrayLike | None
) -> diffrax.PIDController:
    """Returns the default controller with other tolerances; None keeps one."""
    default = _default_tolerance()
    rtol = _number("rtol", default if rtol is None else rtol)
    atol = _number("atol", default if atol is None else atol)
    return adaptive(rtol, atol)


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


def within_reach(
    controller: diffrax.AbstractStepSizeController,
) -> diffrax.AbstractStepSizeController:
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
