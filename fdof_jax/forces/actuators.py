"""Actuators with masses of their own."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ..linkage.fields import Values, field
from ..linkage.frames import cross, dot, length_of, plane_vector, scalar_frames
from ..linkage.linkage import Linkage, joints_of
from ..linkage.topology import real_joints
from .element import InertialElement
from .points import Between, Load, Point, over


class Armature(InertialElement):
    """Rotors geared to the joints: inertia that turns with a joint's relative rate.

    As in MuJoCo, the rate of the link that carries the rotor is left out. From gear
    ratios of 50 on, accelerations are right to about half a percent. For lower ones use
    `Rotor`, which is exact.

    **Arguments:** `inertia`: the rotor's inertia times the square of the gear ratio,
    one per joint or one for all, not negative [kg m^2; kg for a prismatic joint].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> rotors, zero = (fj.forces.Armature(0.5),), [0, 0, 0]
    >>> fj.forward_dynamics(arm, zero, zero, zero, rotors).tolist()  # slower than -g
    [-5.664, 2.225, 1.82]
    """

    inertia: Values = field(unit="kg m^2 or kg", minimum=0)

    def coordinates(self, q, linkage):
        return q

    def weights(self, linkage):
        return jnp.broadcast_to(self.inertia, joints_of(linkage))

    def loads(self, t, q, qd, qdd, linkage):
        """Returns no loads: the rotors act in the joints."""
        return ()


class Rotor(InertialElement):
    """Rotors of motors, carried by the links before their joints: exact coupling.

    A rotor turns about an axis perpendicular to the plane, at the rate of the link
    before the joint plus gear * qd. Its mass belongs to that link. From gear ratios of
    50 on, an `Armature` of gear^2 * inertia is as good.

    **Arguments:** one per joint or one for all; fixed pairs have no rotor.

    - `inertia`: of the rotor itself, not negative [kg m^2].
    - `gear`: angle of the rotor, relative to the link before, per joint angle [1] or
      metre of a slide [rad/m]; negative if it turns the other way. The gear of a
      `DCMotor` is its magnitude.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.Linkage(
    ...     "RR", length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1, 1], inertia=[0.1] * 2)
    >>> direct = fj.forces.Rotor(inertia=[0, 0.2], gear=1)  # turns as the second link
    >>> (fj.mass_matrix(arm, [0, 0], (direct,)) - fj.mass_matrix(arm, [0, 0])).tolist()
    [[0.2, 0.2], [0.2, 0.2]]
    """

    inertia: Values = field(unit="kg m^2", minimum=0)
    gear: Values = field(unit="1 or rad/m")

    def coordinates(self, q, linkage):
        turns = jnp.where(jnp.stack(real_joints(linkage.ef)), q, 0)
        before = jnp.cumsum(turns) - turns  # by which the link before has turned
        return before + self.gear * q

    def weights(self, linkage):
        return jnp.where(linkage.fixed, 0, self.inertia)

    def loads(self, t, q, qd, qdd, linkage):
        """Returns the rotors' moments on the links that carry them."""
        spin_up = self.coordinates(qdd, linkage)  # as they are linear
        moments = -self.weights(linkage) * spin_up
        return tuple(Load(Point(k), (0, 0), moment) for k, moment in enumerate(moments))


class LinearActuator(Between, InertialElement):
    """A cylinder and a piston between two points, and the force between them.

    Both bodies lie along the line between their pins and add no degree of freedom.

    **Arguments:**

    - `a`, `b`: the `Point`s of the pins, the cylinder's and the piston's.
    - `force`: pushes the pins apart [N]; may be a function of (t, length, rate) [s, m,
      m/s].
    - `mass`: of the cylinder and the piston, not negative [kg].
    - `com`: distances of their mass centres, the cylinder's from `a` towards `b`, the
      piston's from `b` towards `a` [m].
    - `inertia`: about their mass centres, not negative [kg m^2].

    **Raises:** ValueError for malformed arguments. Where the pins meet, motions end as
    not finite.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> import jax.numpy as jnp
    >>> lift = fj.LinearActuator(fj.Point(0, 0, -1), fj.Point(1, 1), force=100)
    >>> lift(0.0, jnp.zeros(3), jnp.zeros(3), arm).tolist()  # lever sqrt(1/2) m
    [70.711, 0.0, 0.0]
    """

    force: Any = field((), unit="N", function=True, default=0.0, kw_only=True)
    mass: Values = field((2,), unit="kg", minimum=0, default=(0.0, 0.0), kw_only=True)
    com: Values = field((2,), unit="m", default=(0.0, 0.0), kw_only=True)
    inertia: Values = field(
        (2,), unit="kg m^2", minimum=0, default=(0.0, 0.0), kw_only=True
    )

    def _bodies(self, linkage: Linkage, q: Array) -> tuple[Array, Array, Array]:
        """Mass centres of cylinder and piston, and the vector between the pins."""
        frames = scalar_frames(linkage, tuple(q))
        vector = self.vector(frames)
        unit = vector * over(length_of(vector))
        cylinder = self.a.place(frames) + self.com[0] * unit
        return cylinder, self.b.place(frames) - self.com[1] * unit, vector

    def coordinates(self, q, linkage):
        cylinder, piston, vector = self._bodies(linkage, q)
        angle = jnp.arctan2(vector.imag, vector.real)
        places = cylinder.real, cylinder.imag, piston.real, piston.imag
        return jnp.stack([*places, angle])

    def weights(self, linkage):
        return jnp.append(jnp.repeat(self.mass, 2), jnp.sum(self.inertia))

    def potential_energy(self, q, linkage):
        cylinder, piston, _ = self._bodies(linkage, q)
        height = jnp.stack([cylinder.imag, piston.imag])
        return linkage.gravity * jnp.sum(self.mass * height)

    def __call__(self, t, q, qd, linkage):
        frames = scalar_frames(linkage, tuple(q))
        vector = self.vector(frames)
        length = length_of(vector)
        slopes = jnp.stack(self.slopes(frames, vector)) * over(length)
        return self.value_of("force", t, length, slopes @ qd) * slopes

    def loads(
        self, t: Array, q: Array, qd: Array, qdd: Array, linkage: Linkage
    ) -> tuple[Load, Load]:
        """Returns the pins' loads on the links: the force, weight and inertia."""
        x1, y1, x2, y2, turning = self.accelerations(q, qd, qdd, linkage)
        weight = 1j * linkage.gravity
        cylinder = self.mass[0] * (plane_vector(x1, y1) + weight)
        piston = self.mass[1] * (plane_vector(x2, y2) + weight)
        vector, rate = jax.jvp(lambda q: self._bodies(linkage, q)[2], (q,), (qd,))
        length = length_of(vector)
        unit = vector / length
        # The moments about the first pin determine each pin's sideways share.
        about_a = (
            jnp.sum(self.inertia) * turning
            + self.com[0] * cross(unit, cylinder)
            + (length - self.com[1]) * cross(unit, piston)
        )
        push = self.value_of("force", t, length, dot(unit, rate))
        held = dot(unit, piston) - push
        on_b = (held + 1j * about_a / length) * unit  # by the link on the piston
        on_a = cylinder + piston - on_b
        return Load(self.a, -on_a), Load(self.b, -on_b)
