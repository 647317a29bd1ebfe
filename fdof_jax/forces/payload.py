"""Masses that an arm takes and lets go."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..linkage.fields import Condition, Truth, Values, field, has_come, of_kind
from ..linkage.frames import plane_vector, scalar_frames
from .element import InertialElement
from .points import Load, Point


class Payload(InertialElement):
    """A body that is fixed to a link between two known times.

    At pick-up, an impulse changes the rates of all joints; generalised momenta are
    kept. Release changes no rate. Functions without a time, such as `mass_matrix`, take
    its `at(t)`.

    **Arguments:**

    - `place`: the `Point` of a moving link at which its mass centre is fixed.
    - `mass`, `inertia`: not negative [kg, kg m^2].
    - `begin`, `end`: times of pick-up and release [s]; by default the arm always has
      it. A payload picked up at the start of a motion, or before, causes no impulse.
    - `velocity`: before pick-up, (x, y) [m/s] or (x, y, angular rate) [m/s, rad/s]; by
      default 0.

    **Raises:** ValueError for malformed arguments, and unless begin < end.

    >>> import fdof_jax as fj
    >>> bar = fj.Linkage(
    ...     "R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12], gravity=0)
    >>> load = fj.forces.Payload(fj.Point(1, along=1), 1.5, begin=0.5)
    >>> motion = fj.simulate(bar, fj.State([0.0], [2.0]), [0, 1.0], (load,))
    >>> float(motion.qd[-1, 0])  # 4/11 rad/s
    0.364
    """

    place: Point = of_kind(Point)
    mass: Values = field((), unit="kg", minimum=0)
    inertia: Values = field((), unit="kg m^2", minimum=0, default=0.0)
    begin: Values | None = field((), unit="s", default=None, kw_only=True)
    end: Values | None = field((), unit="s", default=None, kw_only=True)
    velocity: Values = field(
        (None,), unit="m/s and rad/s", default=(0.0, 0.0), kw_only=True
    )

    def conditions(self):
        count = len(self.velocity)
        yield Condition(count in (2, 3), "velocity", "two or three numbers", count)
        moves = self.place.link > 0
        yield Condition(moves, "place", "a point of a moving link", self.place)
        used = (self.velocity == 0).all() | (self.begin is not None)
        yield Condition(used, "velocity", "zeros without begin", self.velocity)
        yield from self.ordered("begin", "end")

    @property
    def jump_ts(self) -> Array | None:
        times = [t for t in (self.begin, self.end) if t is not None]
        return jnp.stack(times) if times else None

    def there(self, t: Array | np.ndarray) -> Truth:
        """Returns whether the arm has it at a time."""
        taken = True if self.begin is None else has_come(self.begin, t)
        return taken & (True if self.end is None else ~has_come(self.end, t))

    def at(self, t: Array | np.ndarray) -> "Payload":
        """Returns the payload at a time, without mass unless the arm has it."""
        if self.jump_ts is None:
            return self
        there = self.there(t)
        scaled = jnp.where(there, self.mass, 0), jnp.where(there, self.inertia, 0)
        return eqx.tree_at(
            lambda p: (p.mass, p.inertia, p.begin, p.end, p.velocity),
            self,
            (*scaled, None, None, jnp.zeros_like(self.velocity)),
            is_leaf=lambda leaf: leaf is None,
        )

    def coordinates(self, q, linkage):
        frames = scalar_frames(linkage, tuple(q))
        place = self.place.place(frames)
        turns = jnp.where(jnp.stack(frames.revolute), q, 0)
        turned = jnp.sum(jnp.where(jnp.arange(q.size) < self.place.link, turns, 0))
        return jnp.stack([place.real, place.imag, turned])

    def weights(self, linkage):
        return jnp.stack([self.mass, self.mass, self.inertia])

    def potential_energy(self, q, linkage):
        _, height, _ = self.coordinates(q, linkage)
        return self.mass * linkage.gravity * height

    @property
    def arriving(self) -> Array:
        """The rates of its coordinates before pick-up, (3,)."""
        return jnp.zeros(3).at[: len(self.velocity)].set(self.velocity)

    def loads(self, t, q, qd, qdd, linkage):
        """Returns its weight and inertia as a load on its place."""
        x, y, turning = self.accelerations(q, qd, qdd, linkage)
        force = -self.mass * (plane_vector(x, y) + 1j * linkage.gravity)
        return (Load(self.place, force, -self.inertia * turning),)
