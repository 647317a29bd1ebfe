"""Force elements: forces and torques on the joints besides gravity.

An element is any pytree called as `(t, q, qd, linkage) -> tau`, with joint positions,
velocities and efforts of shape (3,). A scene holds a tuple of elements; their efforts
add up. The PD controller is an element too: see `control`. `simulate` also integrates
the state of a `StatefulElement`. An `InertialElement` moves masses.

Optional attributes of an element, or of a controller's reference:

- `jump_ts`: an array of the times at which its efforts jump [s]; steps end there.
- `check(linkage, ts)`: `simulate` calls it where values are concrete.
- `possible()`: returns whether the values are valid. If not, `simulate` raises
  ValueError; where they are traced, the motion ends as not finite.

Where values are concrete, `simulate` reads `jump_ts` and `possible()` from a copy of
the element with NumPy arrays, for which JAX compiles nothing.

Elements in hot loops may be `ScalarElement`s, which run and compile faster.
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
        """Computes what depends on time alone, for all stages of a step at once."""
        return ()

    @abstractmethod
    def respond(
        self, scheduled: Any, q: Scalars, qd: Scalars, linkage: Linkage
    ) -> tuple[Array, ...]:
        """Computes the three efforts [N or N m] from the result of `schedule`."""

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        scheduled = self.schedule(t, linkage)
        return jnp.stack(self.respond(scheduled, tuple(q), tuple(qd), linkage))


class StatefulElement(eqx.Module):
    """A force element with a state of its own: an integral, a current, a lag.

    A subclass implements both methods; its efforts are in [N or N m].
    """

    @abstractmethod
    def initial_state(self, linkage: Linkage) -> Any:
        """Returns the state at the start: an array or a pytree of arrays."""

    @abstractmethod
    def __call__(
        self, t: Array, q: Array, qd: Array, linkage: Linkage, state: Any
    ) -> tuple[Array, Any]:
        """Returns the efforts (3,) [N or N m] and the rate of the state."""


class InertialElement(eqx.Module):
    """A force element with masses, which add to the equations of motion.

    Its kinetic energy is the sum of weight * (d coordinate/dt)^2 / 2 [J]. For a body,
    the coordinates of the mass centre have the mass as weight, and the angle has the
    inertia. A subclass implements `coordinates` and `weights`.
    """

    @abstractmethod
    def coordinates(self, q: Array, linkage: Linkage) -> Array:
        """Computes places and angles from the joint positions, (n,)."""

    @abstractmethod
    def weights(self, linkage: Linkage) -> Array:
        """Returns the masses and inertias of the coordinates, (n,)."""

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        """Computes the potential energy, () [J]; 0 unless overridden."""
        return jnp.zeros(())

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        """Computes further efforts, (3,) [N or N m]; 0 unless overridden."""
        return jnp.zeros(3)

    def loads(
        self, t: Array, q: Array, qd: Array, qdd: Array, linkage: Linkage
    ) -> tuple[Any, ...] | None:
        """Returns the loads on points of links, a tuple of `points.Load`.

        Only `joint_reactions` calls it, and rejects elements that return None.
        """
        return None


def jumps_of(*parts: Any) -> Array | None:
    """Returns all times at which the parts declare jumps, or None."""
    found = [getattr(part, "jump_ts", None) for part in parts]
    times = [jnp.asarray(jumps) for jumps in found if jumps is not None]
    return jnp.concatenate(times) if times else None
