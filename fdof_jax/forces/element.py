"""Force elements: what acts on the joints besides gravity.

An element is any pytree called as `(t, q, qd, linkage) -> tau`, with joint positions,
velocities and efforts of shape (3,). A scene's elements are a tuple; their efforts
add up. The PD controller is one too: see `control`. A `StatefulElement` has a state of
its own, which `simulate` integrates along; an `InertialElement` moves masses.

An element, or a controller's reference, whose efforts jump at known times may have them
as an attribute `jump_ts`, an array [s]: steps then end there. One with a method
`check(linkage, ts)` is asked at the door of `simulate` where values are concrete; one
with `possible()`, also where they are traced: motions under an element for which that
is not true end as not finite. At the door `jump_ts` and `possible()` are those of an
element's copy with NumPy arrays, for which JAX compiles nothing.

Elements in hot loops may be `ScalarElement`s, which cost less to run and to compile.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from ..linkage.linkage import Linkage
from ..mechanics.equations import Scalars

Forces = tuple[Any, ...]  # callables (t, q, qd, linkage) -> tau


class ScalarElement(eqx.Module):
    """A force element written in scalars, which fuses with the equations of motion.

    A subclass implements `respond`, and `schedule` if anything in it depends on time.
    """

    def schedule(self, t: Array, linkage: Linkage) -> Any:
        """What depends on time alone: evaluated for all stages of a step at once."""
        return ()

    @abstractmethod
    def respond(
        self, scheduled: Any, q: Scalars, qd: Scalars, linkage: Linkage
    ) -> tuple[Array, ...]:
        """The three efforts [N or N m], given what `schedule` returned."""

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        scheduled = self.schedule(t, linkage)
        return jnp.stack(self.respond(scheduled, tuple(q), tuple(qd), linkage))


class StatefulElement(eqx.Module):
    """A force element with a state of its own: an integral, a current, a lag.

    A subclass implements both methods; what it returns are efforts [N or N m].
    """

    @abstractmethod
    def initial_state(self, linkage: Linkage) -> Any:
        """The state at the start: an array, or a pytree of arrays."""

    @abstractmethod
    def __call__(
        self, t: Array, q: Array, qd: Array, linkage: Linkage, state: Any
    ) -> tuple[Array, Any]:
        """The efforts (3,) [N or N m], and the rate of the state, a pytree like it."""


class InertialElement(eqx.Module):
    """A force element that moves masses: they add to the equations of motion.

    Its kinetic energy is the sum of weight * (d coordinate/dt)^2 / 2 [J]. A body, for
    instance, has the coordinates of its mass centre, whose weights are its mass, and
    its angle, whose weight is its inertia. A subclass implements both methods.
    """

    @abstractmethod
    def coordinates(self, q: Array, linkage: Linkage) -> Array:
        """Places and angles that follow from the joint positions, (n,)."""

    @abstractmethod
    def weights(self, linkage: Linkage) -> Array:
        """Masses and inertias that go with them, (n,)."""

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        """The potential energy, () [J]; 0 unless a subclass says otherwise."""
        return jnp.zeros(())

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        """The efforts besides, (3,) [N or N m]; 0 unless a subclass says otherwise."""
        return jnp.zeros(3)

    def loads(
        self, t: Array, q: Array, qd: Array, qdd: Array, linkage: Linkage
    ) -> tuple[Any, ...] | None:
        """What it does to points of links, a tuple of `points.Load`.

        Only `joint_reactions` asks, which refuses elements that do not say: None.
        """
        return None


def jumps_of(*parts: Any) -> Array | None:
    """The times at which any of these says that it jumps, if one does."""
    found = [getattr(part, "jump_ts", None) for part in parts]
    times = [jnp.asarray(jumps) for jumps in found if jumps is not None]
    return jnp.concatenate(times) if times else None
