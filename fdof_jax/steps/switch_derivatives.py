"""The part of the time of a switch in the derivatives of a motion, to second order.

Steps have constant lengths for derivatives, but the time of a switch depends on the
parameters. At the end of the step to a switch, the state moves on to that time on the
side before, and back on the side after: this changes nothing but derivatives.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from .dopri8 import Arguments, Integrated, Term, constant


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


class Arrival(NamedTuple):
    """The end of a step at which the first function that `switched` is zero."""

    t: Array
    y: Integrated
    args: Arguments
    switched: Array  # none: nothing is zero


@eqx.filter_jit  # traced once, not at each use in a solve
def _value(arrival: Arrival, term: Term) -> Array:
    t, y, args, switched = arrival
    return term.switches(t, y, args)[0][jnp.argmax(switched)]


@eqx.filter_jit
def _slope(arrival: Arrival, term: Term) -> Array:
    return _rate(_value, arrival, term)


def _rate(function: Callable, arrival: Arrival, term: Term) -> Array:
    """Returns the rate of a function of an arrival along the motion.

    It is exact, where differences of samples are lost in rounding if steps are short.
    """
    t, y, args, _ = arrival
    along = lambda t, y: function(arrival._replace(t=t, y=y), term)
    return jax.jvp(along, (t, y), (jnp.ones_like(t), term.vf(t, y, args)))[1]


def _change(function: Callable, arrival: Arrival, term: Term, change: PyTree) -> Array:
    """Returns how a function of an arrival changes with it."""
    _, tangent = eqx.filter_jvp(lambda a: function(a, term), (arrival,), (change,))
    return jnp.zeros_like(arrival.t) if tangent is None else tangent


def _quotient(change: Array, slope: Array) -> Array:
    """Returns how much later a value is zero after a change; 0 without a slope."""
    steep = slope != 0
    return jnp.where(steep, -change / jnp.where(steep, slope, 1), 0)


@eqx.filter_custom_jvp
def lateness(arrival: Arrival, *, term: Term) -> Array:
    """Returns when the function that switched is zero, less the time of arrival.

    This is 0, with derivatives of first and second order.
    """
    return jnp.zeros_like(arrival.t)


@lateness.def_jvp
def _(primals, tangents, *, term):
    (arrival,), (change,) = primals, tangents
    late = lateness(arrival, term=term)
    if not jax.tree.leaves(change):
        return late, late

    def first():
        change_here = _change(_value, arrival, term, change)
        return _quotient(change_here, _slope(arrival, term))

    none = lambda: jnp.zeros_like(late)
    first = jax.lax.cond(jnp.any(arrival.switched), first, none)
    return late, first + _later(late, arrival, first, change, term=term)


@eqx.filter_custom_jvp
def _later(late, arrival, first, change, *, term):
    """Second-order part of `lateness`: its value is 0; only its derivative matters."""
    return jnp.zeros_like(late)


@_later.def_jvp
def _(primals, tangents, *, term):
    (_, arrival, first, change), (along, *_) = primals, tangents
    nothing = _later(*primals, term=term)
    if along is None:
        return nothing, nothing

    def second():
        slope_change = _change(_slope, arrival, term, change)
        slope_change += first * _rate(_slope, arrival, term)
        return _quotient(along * slope_change, _slope(arrival, term))

    none = lambda: jnp.zeros_like(nothing)
    return nothing, jax.lax.cond(jnp.any(arrival.switched), second, none)


class Event(NamedTuple):
    """The instant at which the modes of joints may change.

    - `before`, `t`: times just before it and just after it [s].
    - `fired` (kind, joint): which guards of modes came to their zeros.
    - `late`: 0, whose derivatives are those of the time of the event less `before`.
    """

    before: Array
    t: Array
    fired: Array
    late: Array


class Instant(NamedTuple):
    """A time, the state and the arguments of the equations there."""

    t: Array
    y: Integrated
    args: Arguments


@eqx.filter_custom_jvp
def moved_on(late: Array, instant: Instant, *, term: Term) -> Integrated:
    """Returns the state a time `late` later, which is 0, with derivatives."""
    return instant.y


@moved_on.def_jvp
def _(primals, tangents, *, term):
    (late, instant), (change, changes) = primals, tangents
    there = moved_on(late, instant, term=term)
    field = lambda instant: term.vf(*instant)
    rates = field(Instant(instant.t + late, there, instant.args))
    start = _filled(changes.y, instant.y)
    if change is None:
        return there, start
    # Of second order: how the rates change with the start.
    _, turned = eqx.filter_jvp(field, (instant,), (changes,))
    moved = lambda dy, rate, turn: dy + change * rate + _of_zero(late, turn)
    return there, jax.tree.map(moved, start, rates, _filled(turned, rates))


def _filled(tangents: PyTree, values: PyTree) -> PyTree:
    """Returns tangents, zeros where equinox leaves None because nothing changes."""
    return jax.tree.map(
        lambda value, tangent: jnp.zeros_like(value) if tangent is None else tangent,
        values,
        tangents,
    )


class Moment(NamedTuple):
    """A switch: the arrival there, the sides after it, and whether there is one."""

    arrival: Arrival
    after: Array
    is_one: Array


def _difference(late: Array, moment: Moment, term: Term) -> Integrated:
    """Returns the rates before a switch less those after it.

    With derivatives of first order: the state moves on to the time of the switch on the
    side before, and back on the side after, and the rates are those halfway.
    """
    (t, y, args, _), after, is_one = moment
    both = jnp.stack([args.sides, after])
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
        there = rates(t + _of_zero(late, jnp.full_like(t, 0.5)), between, args, both)
        return jax.tree.map(lambda rate: rate[0] - rate[1], there)

    nothing = lambda: jax.tree.map(jnp.zeros_like, y)
    return jax.lax.cond(is_one, difference, nothing)


def _late(moment: Moment, change: PyTree, term: Term) -> tuple[Array, Array]:
    """Returns `lateness` and how it changes."""
    late = lambda moment: lateness(moment.arrival, term=term)
    return eqx.filter_jvp(late, (moment,), (change,))


@eqx.filter_custom_jvp
def gained(moment: Moment, *, term: Term, jumping: bool) -> Integrated:
    """Returns how the time of a switch changes the state: 0, with derivatives.

    Where nothing jumps, first derivatives are 0 too; only second ones need the time of
    the switch, and derivatives of the rates.
    """
    return jax.tree.map(jnp.zeros_like, moment.arrival.y)


@gained.def_jvp
def _(primals, tangents, *, term, jumping):
    (moment,), (change,) = primals, tangents
    nothing = gained(moment, term=term, jumping=jumping)
    if not jax.tree.leaves(change.arrival):
        return nothing, nothing
    gain = _gained_twice(moment, change, term=term, jumping=jumping)
    if jumping:
        late, later = _late(moment, change, term)
        rates = _difference(late, moment, term)
        gain = jax.tree.map(lambda rate, more: later * rate + more, rates, gain)
    return nothing, gain


@eqx.filter_custom_jvp
def _gained_twice(moment, change, *, term, jumping):
    """Second-order part of `gained`: its value is 0; only its derivative matters."""
    return jax.tree.map(jnp.zeros_like, moment.arrival.y)


@_gained_twice.def_jvp
def _(primals, tangents, *, term, jumping):
    nothing = _gained_twice(*primals, term=term, jumping=jumping)
    (moment, first), (second, _) = primals, tangents
    if not jax.tree.leaves(second.arrival):
        return nothing, nothing

    def product(late_along, rates_along):
        """Returns the lateness in one direction times the rates in another."""
        _, later = _late(moment, late_along, term)

        def difference(moment):
            return _difference(lateness(moment.arrival, term=term), moment, term)

        _, turned = eqx.filter_jvp(difference, (moment,), (rates_along,))
        return jax.tree.map(lambda rate: later * rate, turned)

    gain = product(second, first)
    if not jumping:  # the rates are 0, but their derivatives are not
        gain = jax.tree.map(jnp.add, gain, product(first, second))
    return nothing, gain
