"""Formulas with branches, whose changes the integrator locates.

A step keeps to the branches in force at its start, and ends where they change.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from ..base.checks import transformation

# While an element is traced within a solve; of each thread its own.
_DEALING: ContextVar["Switches | None"] = ContextVar("dealing", default=None)


class Switches:
    """Gives each switch of the elements the side in force, in the order of their calls.

    - `sides` (n,): 1 above and -1 below zero, 0 for the function's own sign; None means
      zeros.
    - `values`: the switching functions met; `jumping`: whether efforts jump with their
      entries, None for conditions.
    """

    def __init__(self, sides: Array | None):
        self.sides, self.values, self.jumping, self._count = sides, [], [], 0

    def side_of(self, g: Array, continuous: bool, unit: ArrayLike) -> Array:
        if self._transformation != transformation():
            raise ValueError(
                "switch: expected a call outside of functions that JAX transforms, as "
                "by jax.jit or jax.vmap, because steps end at the zeros of g. Both "
                "`switch` and `clip` take whole arrays."
            )
        self.values.append(g / unit)
        self.jumping += [not continuous] * g.size
        if self.sides is None:
            return g
        # Larger than any function that changes sign, so that the side decides the sign.
        largest = jnp.finfo(self.sides.dtype).max
        return g + (largest * self.sides)[self._next(g.size)].reshape(g.shape)

    def _next(self, count: int) -> slice:
        """Returns the places of the next `count` sides."""
        begin, self._count = self._count, self._count + count
        return slice(begin, self._count)

    def add(self, values: list[Array], jumping: Sequence[bool | None]) -> None:
        """Adds switches that were met elsewhere, with the sides of `rest`."""
        self.values += values
        self.jumping += jumping
        self._next(sum(g.size for g in values))

    def rest(self) -> Array | None:
        return None if self.sides is None else self.sides[self._count :]

    def all_values(self, dtype: DTypeLike) -> Array:
        """Returns all switching functions met, (n,)."""
        found = [jnp.ravel(g).astype(dtype) for g in self.values]
        return jnp.concatenate(found) if found else jnp.zeros(0, dtype)

    @staticmethod
    def dealing() -> "Switches | None":
        """Returns those that are dealt to what is traced now, None outside a solve."""
        return _DEALING.get()

    @contextmanager
    def dealt(self) -> Iterator[None]:
        """Deals out sides to the switches traced in this context."""
        self._transformation = transformation()
        before = _DEALING.set(self)
        try:
            yield
        finally:
            _DEALING.reset(before)


def switch(
    g: ArrayLike, above: ArrayLike, below: ArrayLike, *, continuous: bool = False
) -> Array:
    """Returns `above` where the switching function `g` is positive, `below` elsewhere.

    Adaptive steps end where `g` changes its sign, and derivatives include the effect of
    that time. `g` may have any unit [such as m, rad or N] in which it is not tiny: less
    than 1e-13 counts as 0. Both branches are used beyond the zero of `g`, and must be
    smooth and finite there. For jumps at known times declare `jump_ts` instead.

    `continuous`: whether efforts are the same on both sides where `g` is 0; programs
    for derivatives then compile faster.

    **Raises:** ValueError within a function that the element itself transforms, as by
    `jax.jit`, `jax.vmap` or `jax.grad`.

    >>> import fdof_jax as fj
    >>> class Drag(fj.Element):  # air on one side, water on the other
    ...     def __call__(self, t, q, qd, linkage):
    ...         return -fj.forces.switch(q, 0.1, 20.0) * qd
    >>> arm = fj.scenes.fig5().linkage
    >>> import jax.numpy as jnp
    >>> Drag()(0.0, jnp.array([1.0, -1, 1]), jnp.ones(3), arm).tolist()
    [-0.1, -20.0, -0.1]
    """
    return _chosen(jnp.asarray(g), above, below, continuous)


def _chosen(
    g: Array, above: ArrayLike, below: ArrayLike, continuous: bool, unit: ArrayLike = 1
) -> Array:
    """As `switch`, of a function that may be tiny, but not in this unit."""
    switches = Switches.dealing()
    side = g if switches is None else switches.side_of(g, continuous, unit)
    return jnp.where(side > 0, above, below)


def clip(x: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Returns `x` clipped to [low, high]; adaptive steps end where clipping begins.

    All have one unit [such as N or N m]. At an end of the interval, the derivative is
    that within it.

    >>> import fdof_jax as fj
    >>> fj.forces.clip([-3.0, 0.5, 3.0], -1, 2).tolist()
    [-1.0, 0.5, 2.0]
    """
    x, low, high = jnp.broadcast_arrays(*map(jnp.asarray, (x, low, high)))
    width = high - low
    unit = jnp.where((width > 0) & (width < jnp.inf), width, 1)
    within = _chosen(x - high, high, x, True, unit)
    return _chosen(low - x, low, within, True, unit)
