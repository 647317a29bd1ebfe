"""The very zeros of conditions: where resets act, and runs end.

Steps end close to a zero, which is enough for switches alone.
"""

import jax
import jax.numpy as jnp
from jax import Array

from ..base.trees import constant
from .term import Arguments, Integrated, Term
from .zeros import OFFSET, ROUNDING

# Of Newton's steps to a zero: right to rounding, with second derivatives.
# The last of them is at most this share of all.
_NEWTON, _CONVERGED = 3, 0.01


def places_of(conditions: tuple[tuple[int, int], ...]) -> Array:
    return jnp.array([place for place, _ in conditions])


def met(conditions: tuple[tuple[int, int], ...], passed: Array, after: Array) -> Array:
    """Returns which conditions (place, direction) are met, (condition,).

    `passed`: which functions passed a zero; `after`: all sides then. Direction 0 stands
    for both.
    """
    places = places_of(conditions)
    wanted = jnp.array([direction for _, direction in conditions])
    return passed[places] & ((wanted == 0) | (wanted == after[places]))


def at_zero(
    term: Term, t: Array, y: Integrated, args: Arguments, which: Array, near: Array
) -> tuple[Array, Integrated]:
    """Returns time and state at the zero of a function, by Newton's method.

    They are right to rounding and to second derivatives. Without a zero nearby they are
    those given.
    """

    def function(time):
        there = later(term, time, t, y, args)
        return term.switches(t + time, there, args)[0][which]

    time = change = jnp.zeros_like(t)
    for _ in range(_NEWTON):
        value, slope = jax.jvp(function, (time,), (jnp.ones_like(t),))
        steep = near & (slope != 0)
        change = jnp.where(steep, value / jnp.where(steep, slope, 1), 0)
        time = time - change
    time = jnp.where(jnp.abs(change) <= _CONVERGED * jnp.abs(time), time, 0)
    return t + time, later(term, time, t, y, args)


def later(
    term: Term, time: Array, t: Array, y: Integrated, args: Arguments
) -> Integrated:
    """Returns the state a short time later, by the midpoint rule."""
    middle = _along(y, time / 2, term.vf(t, y, args))
    return _along(y, time, term.vf(t + time / 2, middle, args))


def _along(y: Integrated, time: Array, rates: Integrated) -> Integrated:
    return jax.tree.map(lambda a, rate: a + time * rate, y, rates)


def sides_after(
    term: Term, places: Array, t: Array, before: tuple[Integrated, Arguments],
    after: tuple[Integrated, Arguments], sizes: Array,
) -> Array:  # fmt: skip
    """Returns the sides of functions after a reset.

    A function that is 0 goes on, unless the reset turns its rate round or stops it:
    then it is reset again. `before`, `after`: states and arguments at the reset.
    """

    def at(state: tuple[Integrated, Arguments]) -> tuple[Array, Array]:
        y, args = state
        function = lambda t, y: term.switches(t, y, args)[0][places]
        return constant(
            jax.jvp(function, (t, y), (jnp.ones_like(t), term.vf(t, y, args)))
        )

    (_, arrives), (values, leaves) = at(before), at(after)
    eps, sides = jnp.finfo(t.dtype).eps, before[1].sides[places]
    # As near as steps end to zeros.
    on_zero = jnp.abs(values) <= 2 * (eps**OFFSET * sizes[places] + ROUNDING * eps)
    goes_on = jnp.sign(arrives) * jnp.sign(leaves) > 0
    there = jnp.where(goes_on, -sides, sides)
    return jnp.where(on_zero, there, jnp.where(values > 0, 1.0, -1.0))
