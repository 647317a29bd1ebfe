"""Derivatives of the time of an event, to second order.

Steps have constant lengths for derivatives, but events do not have constant times. So
the state moves on to that time with the equations before, and back with those after:
only its derivatives change.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from ..base.trees import per_member
from .term import Arguments, Integrated, Term


class Event(NamedTuple):
    """The instant at which the modes of joints may change.

    - `before`, `t`: times just before and just after it [s], with its derivatives; of a
      reset, `t` is exact.
    - `fired` (kind, joint): which guards of modes came to their zeros.
    - `resets` (reset,): which elements reset the state, or None.
    """

    before: Array
    t: Array
    fired: Array
    resets: Any  # Array | None


@jax.custom_jvp
def of_zero(zero: Array, factor: Array) -> Array:
    """Multiplies `factor` by `zero`, whose value is 0 but whose derivatives are not.

    The factor's own derivatives then enter second derivatives alone.
    """
    return per_member(jnp.zeros_like(factor), (zero, factor))


@of_zero.defjvp
def _(primals, tangents):
    (zero, factor), (change, factor_change) = primals, tangents
    product = of_zero(zero, factor)
    return product, change * factor + of_zero(zero, factor_change)


def _straight(late: Array, y: Integrated, rates: Integrated) -> Integrated:
    return jax.tree.map(lambda a, rate: a + of_zero(late, rate), y, rates)


@eqx.filter_jit  # traced once, not at each use in a solve
def moved(
    late: Array, t: Array, y: Integrated, args: Arguments, term: Term
) -> Integrated:
    """Returns the state a time `late` later, which is 0, with derivatives.

    The midpoint rule is right to second order.
    """
    middle = _straight(late / 2, y, term.vf(t, y, args))
    return _straight(late, y, term.vf(t + late / 2, middle, args))


@eqx.filter_jit
def lateness(
    t: Array, y: Integrated, args: Arguments, which: Array, term: Term
) -> Array:
    """Returns when a switching function is 0, less the time `t` of arrival there.

    This is 0, with derivatives. Two of Newton's steps are right to second order, the
    second with the slope halfway. Without a slope nothing is late.
    """
    function = lambda t, y: term.switches(t, y, args)[0][which]
    value = function(t, y)
    zero, late = value - jax.lax.stop_gradient(value), jnp.zeros_like(t)
    for _ in range(2):
        half = late / 2
        middle = t + half, _straight(half, y, term.vf(t, y, args))
        # Exact, where differences of samples are lost in rounding if steps are short.
        along = jnp.ones_like(t), term.vf(*middle, args)
        _, slope = jax.jvp(function, middle, along)
        steep = slope != 0
        late = -of_zero(zero, jnp.where(steep, 1 / jnp.where(steep, slope, 1), 0))
    return late


def gained(
    t: Array, y: Integrated, before: Arguments, after: Arguments, switched: Array, *,
    term: Term,
) -> Integrated:  # fmt: skip
    """Returns how the time of a switch changes the state: 0, with derivatives.

    `before`, `after`: the arguments there; `switched`: which functions are 0, if any.
    """

    def across():
        late = lateness(t, y, before, jnp.argmax(switched), term)
        there = moved(late, t, y, before, term)
        back = moved(-late, t + late, there, after, term)
        return jax.tree.map(jnp.subtract, back, y)

    nothing = lambda: jax.tree.map(jnp.zeros_like, y)
    return jax.lax.cond(jnp.any(switched), across, nothing)


@eqx.filter_custom_jvp
def gained_at_kink(*at: PyTree, term: Term) -> Integrated:
    """Returns `gained` where no rate jumps: its first derivatives are 0, too.

    They are not even traced, which keeps programs short.
    """
    return per_member(jax.tree.map(jnp.zeros_like, at[1]), at)


@gained_at_kink.def_jvp
def _(at, changes, *, term):
    gain = gained_at_kink(*at, term=term)
    return gain, _first_order(at, changes, term=term)


@eqx.filter_custom_jvp
def _first_order(at, changes, *, term):
    """First derivative along `changes`: only its own derivative matters."""
    return per_member(jax.tree.map(jnp.zeros_like, at[1]), (at, changes))


@_first_order.def_jvp
def _(primals, tangents, *, term):
    (at, changes), (along, _) = primals, tangents
    first = lambda *at: eqx.filter_jvp(partial(gained, term=term), at, changes)[1]
    _, second = eqx.filter_jvp(first, at, along)
    return _first_order(at, changes, term=term), second
