"""The part of the time of a switch in the derivatives of a motion, to second order.

Steps have constant lengths for derivatives, but the time of a switch depends on the
parameters. At the end of the step to a switch, the state moves on to that time on the
side before, and back on the side after: this changes nothing but derivatives.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from .dopri8 import constant
from .zeros_in_steps import bend_at_end, slope_at_end


@eqx.filter_jit
def lateness_of(margins: Array, switched: Array) -> Array:
    """Returns the zero of the first margin that `switched`, as a share of the step.

    It is at the end of the step, 0 with derivatives, of second order.
    """
    margin = margins[:, jnp.argmax(switched), None]
    slope, bend = slope_at_end(margin)[0], constant(bend_at_end(margin))[0]
    slope = jnp.where((slope == 0) | ~switched.any(), 1, slope)
    late = _of_zero(margin[-1, 0] - constant(margin[-1, 0]), -1 / slope)
    return late - _of_zero(late, _of_zero(late, bend / (2 * slope)))


def first_of(switched: Array) -> Array:
    """Returns whether each switch is the first of those that switched."""
    return switched & (jnp.cumsum(switched) == 1)


@jax.custom_jvp
def _of_zero(zero: Array, factor: Array) -> Array:
    """Multiplies `factor` by `zero`, whose value is 0 but whose derivatives are not.

    The factor's own derivatives then enter second derivatives alone.
    """
    return jnp.zeros_like(factor)


@_of_zero.defjvp
def _(primals, tangents):
    (zero, factor), (change, factor_change) = primals, tangents
    product = _of_zero(zero, factor)
    return product, change * factor + _of_zero(zero, factor_change)


class Moment(NamedTuple):
    """A switch: time, state, arguments, and the sides before and after it."""

    t: Array
    y: Any
    args: Any
    before: Array
    after: Array
    is_one: Array


def _difference(late: Array, moment: Moment, term: Any) -> Any:
    """Returns the rates before a switch less those after it.

    With derivatives of first order: the state moves on to the time of the switch on the
    side before, and back on the side after, and the rates are those halfway.
    """
    t, y, args, before, after, is_one = moment
    both = jnp.stack([before, after])
    rates = jax.vmap(
        lambda time, y, args, sides: term.vf(time, y, args._replace(sides=sides)),
        in_axes=(None, 0, None, 0),
    )

    def halfway(a, rate):
        before, after = rate
        ways = before / 2, before - after / 2
        return jnp.stack([a + _of_zero(late, way) for way in ways])

    def difference():
        twice = jax.tree.map(lambda a: jnp.stack([a, a]), y)
        between = jax.tree.map(halfway, y, rates(*constant((t, twice, args)), both))  # pyright: ignore[reportCallIssue]
        found = rates(t + _of_zero(late, jnp.full_like(t, 0.5)), between, args, both)
        return jax.tree.map(lambda rate: rate[0] - rate[1], found)

    nothing = lambda: jax.tree.map(jnp.zeros_like, y)
    return jax.lax.cond(is_one, difference, nothing)


@eqx.filter_custom_jvp
def gained(late: Array, moment: Moment, *, term: Any, jumping: bool) -> Any:
    """Returns how the time of a switch changes the state: 0, with derivatives.

    Where nothing jumps, first derivatives are 0 too; only second ones need derivatives
    of the rates.
    """
    return jax.tree.map(jnp.zeros_like, moment.y)


@gained.def_jvp
def _(primals, tangents, *, term, jumping):
    (late, moment), (change, changes) = primals, tangents
    nothing = gained(late, moment, term=term, jumping=jumping)
    if change is None:
        return nothing, nothing
    gain = _gained_twice(late, moment, change, changes, term=term, jumping=jumping)
    if jumping:
        rates = _difference(late, moment, term)
        gain = jax.tree.map(lambda rate, rest: change * rate + rest, rates, gain)
    return nothing, gain


@eqx.filter_custom_jvp
def _gained_twice(late, moment, change, changes, *, term, jumping):
    """Returns the part of a derivative of `gained` that is 0, with derivatives."""
    return jax.tree.map(jnp.zeros_like, moment.y)


@_gained_twice.def_jvp
def _(primals, tangents, *, term, jumping):
    nothing = _gained_twice(*primals, term=term, jumping=jumping)
    late, moment, *first = primals
    second = tangents[:2]
    if second[0] is None:
        return nothing, nothing

    def along(directions):
        found = lambda late, moment: _difference(late, moment, term)
        return eqx.filter_jvp(found, (late, moment), tuple(directions))[1]

    gain = jax.tree.map(lambda rate: second[0] * rate, along(first))
    if not jumping:  # the rates are 0, but their derivatives are not
        gain = jax.tree.map(
            lambda sum, rate: sum + first[0] * rate, gain, along(second)
        )
    return nothing, gain
