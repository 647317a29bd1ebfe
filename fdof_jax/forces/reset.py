"""States that jump where a condition is met."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.checks import function, one_of, shown
from ..linkage.linkage import Linkage
from .element import Element, Forces, element_of
from .switches import switch

_WHEN = "a function (t, q, qd, linkage) that returns a number"
_THEN = "a function (t, q, qd, linkage) that returns positions and velocities (q, qd)"


class Reset(Element):
    """Replaces the state where a function of it passes 0, such as at a footfall.

    First and second derivatives include the time of the jump. `Solution.events` records
    it as joint 0; `Solution.taken` counts the energy of links and loads that it takes.

    After a jump `when` may still be 0; the next one comes when it passes 0 again. A
    start on 0 does not count. Where an impact, a payload or another reset carries
    `when` over 0, the state jumps at once. Jumps that follow ever faster end the motion
    ("too many switches"); `HardStops` hold what comes to rest. A new state that is not
    finite, or beyond a hard stop, ends it too ("not finite").

    **Arguments:**

    - `when`: `(t, q, qd, linkage) -> number`, of time [s], joint positions and
      velocities (n,) [m or rad], smooth near its zeros, in any unit in which it is not
      tiny.
    - `then`: `(t, q, qd, linkage) -> (q, qd)`: the state after the jump, ignored at
      fixed pairs.
    - `direction`: 1 if only rises of `when` count, -1 if only falls, 0 for both.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> kick = fj.forces.Reset(
    ...     when=lambda t, q, qd, linkage: fj.tip_position(linkage, q)[1] + 2,
    ...     then=lambda t, q, qd, linkage: (q, 0.5 * qd))
    >>> motion = fj.simulate(arm, start, [0, 1.0], (kick,))
    >>> motion.events.table["event"].tolist(), float(motion.taken[-1])  # [J]
    (['is reset'], 33.973)
    """

    when: Element
    then: Element
    direction: int

    def __init__(self, when: Callable, then: Callable, direction: int = 0):
        self.when = element_of(function("when", when, _WHEN))
        self.then = element_of(function("then", then, _THEN))
        self.direction = one_of("direction", direction, (-1, 0, 1))

    def arguments(self) -> dict[str, Any]:
        return {"when": self.when, "then": self.then, "direction": self.direction}

    @property
    def jump_ts(self) -> None:
        """None: the times are not known before."""

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        return condition(self.when(t, q, qd, linkage), f"when: expected {_WHEN}", q)

    def state_after(
        self, t: Array, q: Array, qd: Array, linkage: Linkage
    ) -> tuple[Array, Array]:
        """Returns the joint positions and velocities after the jump, (n,) each."""
        answer: Any = self.then(t, q, qd, linkage)
        pair = isinstance(answer, tuple | list) and len(answer) == 2
        shapes = [*map(jnp.shape, answer)] if pair else None
        if shapes != [q.shape, q.shape]:
            raise ValueError(
                f"then: expected {_THEN}, of shape {q.shape} each, got "
                f"{shapes or 'no pair'}."
            )
        new_q, new_qd = (jnp.asarray(value, q.dtype) for value in answer)
        return new_q, new_qd


def condition(value: Any, expected: str, q: Array) -> Array:
    """Returns no efforts; the zeros of a number become ends of steps.

    Where it is NaN, so are the efforts. Raises ValueError unless it is a real number.
    """
    given = isinstance(value, float | int | np.ndarray | np.generic | Array)
    if not given or jnp.shape(value) != ():
        got = f"one of shape {jnp.shape(value)}" if given else shown(value)
        raise ValueError(f"{expected}, got {got}.")
    if (dtype := jnp.result_type(value)).kind not in "iuf":
        raise ValueError(f"{expected} which passes 0, got one of type {dtype}.")
    number = jnp.asarray(value, q.dtype)
    none = jnp.full_like(q, jnp.where(jnp.isnan(number), jnp.nan, 0))
    # A switch of which nothing depends on the side.
    return switch(number, none, none, continuous=True)


def resets_in(forces: Forces) -> tuple[Reset, ...]:
    """Returns the resets among elements."""
    return tuple(element for element in forces if isinstance(element, Reset))
