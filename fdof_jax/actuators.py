"""Actuators with masses of their own."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .forces import InertialElement
from .linkage import Linkage
from .points import Point, Separation
from .validation import real_array


class Armature(InertialElement):
    """Rotors geared to the joints: inertia that turns with a joint's relative rate.

    **Arguments:** `inertia`: one per joint or one for all, not negative; of the rotor
    times the square of the gear ratio [kg m^2; kg for a prismatic joint].

    **Raises:** ValueError for malformed or negative inertias.
    """

    inertia: Float[Array, " joint"]

    def __init__(self, inertia: ArrayLike):
        self.inertia = real_array("inertia", inertia, (3,), minimum=0, broadcast=True)

    def coordinates(self, q, linkage):
        return q

    def weights(self, linkage):
        return self.inertia


class LinearActuator(InertialElement):
    """A cylinder and a piston between two points, and the force between them.

    Both are bodies that lie along the line of the two pins: where the pins go, they
    follow, exactly and without a degree of freedom of their own.

    **Arguments:**

    - `a`, `b`: the `Point`s of the pins, the cylinder's and the piston's.
    - `force`: what pushes the pins apart [N], or a function of (t, length, rate) that
      returns it [s, m, m/s].
    - `mass`: of the cylinder and the piston, not negative [kg].
    - `com`: distances of their mass centres, the cylinder's from `a` towards `b`, the
      piston's from `b` towards `a` [m].
    - `inertia`: about their mass centres, not negative [kg m^2].

    **Raises:** ValueError for malformed arguments. Where the pins meet, a line has no
    direction, and motions end as not finite.
    """

    ends: Separation
    force: Any
    mass: Float[Array, " 2"]
    com: Float[Array, " 2"]
    inertia: Float[Array, " 2"]

    def __init__(
        self,
        a: Point,
        b: Point,
        *,
        force: ArrayLike | Callable[[Array, Array, Array], ArrayLike] = 0.0,
        mass: ArrayLike = (0.0, 0.0),
        com: ArrayLike = (0.0, 0.0),
        inertia: ArrayLike = (0.0, 0.0),
    ):
        self.ends = Separation(a, b)
        self.force = force if callable(force) else real_array("force", force, ())
        self.mass = real_array("mass", mass, (2,), minimum=0)
        self.com = real_array("com", com, (2,))
        self.inertia = real_array("inertia", inertia, (2,), minimum=0)

    def _centers(self, linkage: Linkage, q: Array) -> Array:
        """The mass centres of the cylinder and the piston, (2, 2)."""
        a, b = (p.position(linkage, q) for p in (self.ends.a, self.ends.b))
        unit = (b - a) / jnp.sqrt(jnp.sum((b - a) ** 2))
        return jnp.stack([a + self.com[0] * unit, b - self.com[1] * unit])

    def coordinates(self, q, linkage):
        x, y = self.ends.vector(linkage, q)
        return jnp.append(self._centers(linkage, q).ravel(), jnp.arctan2(y, x))

    def weights(self, linkage):
        return jnp.append(jnp.repeat(self.mass, 2), jnp.sum(self.inertia))

    def potential_energy(self, q, linkage):
        height = self._centers(linkage, q)[:, 1]
        return linkage.gravity * jnp.sum(self.mass * height)

    def __call__(self, t, q, qd, linkage):
        length = lambda q: self.ends.length(linkage, q)
        now, slope = jax.value_and_grad(length)(q)
        force = self.force
        if callable(force):
            force = real_array("force", force(t, now, slope @ qd), ())
        return force * slope
