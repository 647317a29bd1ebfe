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
from .points import Load, Point, Separation
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
        return self._push(t, now, slope @ qd) * slope

    def _push(self, t: Array, length: Array, rate: Array) -> Array:
        if callable(self.force):
            return real_array("force", self.force(t, length, rate), ())
        return self.force

    def loads(
        self, t: Array, q: Array, qd: Array, qdd: Array, linkage: Linkage
    ) -> tuple[Load, Load]:
        """What its pins do to the links, while the joints accelerate by `qdd`.

        Besides the force between them: the weight and the inertia of the two bodies,
        whose sideways part both pins share as the moments about the first one demand.
        """
        along = lambda q, qd: jax.jvp(
            lambda q: self.coordinates(q, linkage), (q,), (qd,)
        )[1]
        _, acceleration = jax.jvp(along, (q, qd), (qd, qdd))
        weight = self.mass[:, None] * jnp.array([[0.0, 1.0]]) * linkage.gravity
        needed = self.mass[:, None] * acceleration[:4].reshape(2, 2) + weight
        length, rate = jax.jvp(lambda q: self.ends.length(linkage, q), (q,), (qd,))
        unit = self.ends.vector(linkage, q) / length
        sideways = jnp.stack([-unit[1], unit[0]])
        turning = jnp.sum(self.inertia) * acceleration[4]
        arms = jnp.stack([self.com[0], length - self.com[1]])
        across = (turning + jnp.sum(arms * (needed @ sideways))) / length
        held = needed[1] @ unit - self._push(t, length, rate)
        on_b = held * unit + across * sideways  # by the link, on the piston
        on_a = needed[0] + needed[1] - on_b
        return Load(self.ends.a, -on_a), Load(self.ends.b, -on_b)
