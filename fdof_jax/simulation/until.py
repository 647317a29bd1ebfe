"""Conditions that end a motion."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array
from jaxtyping import Float, Int

from ..base.checks import function, one_of, refusal
from ..forces.element import Element, Forces, element_of
from ..forces.reset import Reset, condition
from ..linkage.linkage import Linkage

_EXPECTED = "a function (t, q, qd, linkage) that returns a number"


class Until(Element):
    """Ends a motion where a function of its state passes 0.

    `simulate(..., until=g)` takes plain functions. Use an `Until` to choose a
    direction, or among the forces of a `Scene`, a sweep, a fit or a search of gains. A
    motion that starts on the zero does not end there.

    **Arguments:**

    - `g`: `(t, q, qd, linkage) -> number`, of the time [s], joint positions and
      velocities (n,) [m or rad]. It is smooth near its zeros, and not tiny in its unit.
    - `direction`: 1 if the motion ends only where `g` rises through 0, -1 only where it
      falls, 0 for both.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> turns = fj.simulation.Until(lambda t, q, qd, linkage: qd[0], direction=1)
    >>> motion = fj.simulate(arm, start, [0, 5.0], until=turns)
    >>> bool(motion.ended), float(motion.end.t)
    (True, 1.705)
    """

    condition: Element
    direction: int

    def __init__(self, g: Callable, direction: int = 0):
        self.condition = element_of(function("g", g, _EXPECTED))
        self.direction = one_of("direction", direction, (-1, 0, 1))

    def arguments(self) -> dict[str, Any]:
        return {"g": self.condition, "direction": self.direction}

    @property
    def jump_ts(self) -> None:
        """None: nothing happens before the end."""

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        value = self.condition(t, q, qd, linkage)
        return condition(value, f"until: expected {_EXPECTED}", q)


class End(NamedTuple):
    """The end of a motion, with first and second derivatives.

    - `t`: its time [s]; `q`, `qd` (n,): joint positions [m or rad] and velocities.
    - `condition`: the number of the condition that ended it, from 0 in the order of
      `until`; -1 if the motion ended at its last time.

    >>> import fdof_jax as fj
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> below = lambda t, q, qd, linkage: fj.tip_position(linkage, q)[1] + 2
    >>> end = fj.simulate(arm, start, [0, 5.0], until=below).end
    >>> float(end.t), end.q.tolist(), int(end.condition)
    (0.642, [-1.135, 0.2, 0.642], 0)
    """

    t: Float[Array, ""]
    q: Float[Array, " joint"]
    qd: Float[Array, " joint"]
    condition: Int[Array, ""]


def conditions(until: Any) -> tuple[Until, ...]:
    if until is None:
        return ()
    several = until if isinstance(until, tuple | list) else (until,)
    if not several:
        raise refusal("until", f"{_EXPECTED}, an Until, or several such", until)
    return tuple(
        one if isinstance(one, Until) else Until(function("until", one, _EXPECTED))
        for one in several
    )


CONDITIONS = Reset, Until  # of which steps know the switching functions


def conditions_in(forces: Forces) -> tuple[Until, ...]:
    return tuple(element for element in forces if isinstance(element, Until))
