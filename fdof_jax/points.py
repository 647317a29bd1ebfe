"""Points of links, and what pulls or pushes at them."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from .kinematics import link_frames
from .linkage import Linkage
from .validation import instance, real_array, whole_number


class Point(eqx.Module):
    """A point of a link or of the ground.

    **Arguments:**

    - `link`: 0 is the ground, 1 to 3 are the moving links.
    - `along`, `across`: place in the link's own frame, whose origin is its
      characteristic point (the ground's is the ground pivot) and whose first axis is
      its vector A (the ground's: the base angle) [m].

    **Raises:** ValueError for another link or malformed numbers.
    """

    link: Int[Array, ""]
    along: Float[Array, ""]
    across: Float[Array, ""]

    def __init__(self, link: int, along: ArrayLike = 0.0, across: ArrayLike = 0.0):
        if whole_number("link", link, 0) > 3:
            raise ValueError(
                f"link: expected 0 (the ground) or a moving link, 1 to 3, got {link!r}."
            )
        self.link = jnp.asarray(link)
        self.along = real_array("along", along, ())
        self.across = real_array("across", across, ())

    def position(self, linkage: Linkage, q: Array) -> Float[Array, " 2"]:
        """Where it is: (x, y), from the ground pivot [m]."""
        start, direction = link_frames(linkage, q)
        offset = jax.lax.complex(self.along, self.across)
        place = start[self.link] + offset * direction[self.link]
        return jnp.stack([place.real, place.imag])


class Load(NamedTuple):
    """A force and a moment on a point.

    - `force`: (x, y) [N]; `moment`: counter-clockwise [N m].
    """

    point: Point
    force: Array
    moment: Any = 0.0

    def efforts(self, linkage: Linkage, q: Array) -> Array:
        """The joint efforts that do the same work, (3,) [N or N m]."""
        _, pull_back = jax.vjp(lambda q: self.point.position(linkage, q), q)
        (tau,) = pull_back(self.force)
        return tau + self.moment * _angle_slopes(linkage, self.point.link)


class PointElement(eqx.Module):
    """A force element that acts on points of links or of the ground.

    A subclass implements `loads`. Unlike efforts in the joints, which pass through
    them, these loads are carried by the bearings: see `joint_reactions`.
    """

    @abstractmethod
    def loads(
        self, t: Array, q: Array, qd: Array, linkage: Linkage
    ) -> tuple[Load, ...]:
        """What it does to the points."""

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        return sum(
            (load.efforts(linkage, q) for load in self.loads(t, q, qd, linkage)),
            jnp.zeros(3),
        )


def _turned(linkage: Linkage, q: Array, link: Array, vector: Array) -> Array:
    """A vector given in a link's frame."""
    _, direction = link_frames(linkage, q)
    turned = jax.lax.complex(vector[0], vector[1]) * direction[link]
    return jnp.stack([turned.real, turned.imag])


def _angle_slopes(linkage: Linkage, link: Array) -> Array:
    """Derivative of a link's angle in the joint positions, (3,)."""
    before = jnp.arange(3) < link
    return jnp.where(before & (linkage.ef[1::2] > 0.5), 1.0, 0.0)


class Separation(eqx.Module):
    """Two points, and the line between them."""

    a: Point
    b: Point

    def __init__(self, a: Point, b: Point):
        instance("a", a, Point)
        instance("b", b, Point)
        self.a, self.b = a, b

    def vector(self, linkage: Linkage, q: Array) -> Array:
        """From `a` to `b`, (2,) [m]."""
        return self.b.position(linkage, q) - self.a.position(linkage, q)

    def length(self, linkage: Linkage, q: Array) -> Array:
        """Their distance [m]; its derivative is 0 where it is 0."""
        square = jnp.sum(self.vector(linkage, q) ** 2)
        apart = square > 0
        return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)


class SpringDamper(PointElement):
    """A spring and a damper between two points, along the line that joins them.

    The tension is stiffness * (length - rest_length) + damping * d(length)/dt. With a
    rest length, points that meet have no line: the force is then 0.

    **Arguments:**

    - `a`, `b`: the two `Point`s.
    - `stiffness` [N/m], `damping` [N s/m], `rest_length` [m]: not negative.
    - `one_sided`: "cable" pulls and never pushes, "bumper" pushes and never pulls, and
      neither does anything on the other side of the rest length. False: both.

    **Raises:** ValueError for malformed arguments.
    """

    ends: Separation
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    rest_length: Float[Array, ""]
    side: Int[Array, ""]  # 1: cable, -1: bumper, 0: both

    def __init__(
        self,
        a: Point,
        b: Point,
        *,
        stiffness: ArrayLike = 0.0,
        damping: ArrayLike = 0.0,
        rest_length: ArrayLike = 0.0,
        one_sided: str | bool = False,
    ):
        self.ends = Separation(a, b)
        self.stiffness = real_array("stiffness", stiffness, (), minimum=0)
        self.damping = real_array("damping", damping, (), minimum=0)
        self.rest_length = real_array("rest_length", rest_length, (), minimum=0)
        sides = {False: 0, "cable": 1, "bumper": -1}
        if not isinstance(one_sided, str | bool) or one_sided not in sides:
            raise ValueError(
                f"one_sided: expected False, 'cable' or 'bumper', got {one_sided!r}."
            )
        self.side = jnp.asarray(sides[one_sided])

    def loads(self, t, q, qd, linkage):
        length, rate = jax.jvp(lambda q: self.ends.length(linkage, q), (q,), (qd,))
        tension = self.stiffness * (length - self.rest_length) + self.damping * rate
        # Of the whole, what remains when the smooth pull of a spring is taken off.
        other = self.damping * rate - self.stiffness * self.rest_length
        beyond = self.side * (length - self.rest_length) > 0
        works = (self.side == 0) | (beyond & (self.side * tension > 0))
        vector = self.ends.vector(linkage, q)
        unit = vector / jnp.where(length > 0, length, 1)
        pull = jnp.where(works, self.stiffness * vector + other * unit, 0)
        return Load(self.ends.a, pull), Load(self.ends.b, -pull)

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        """The energy of the spring [J]."""
        stretch = self.ends.length(linkage, q) - self.rest_length
        works = (self.side == 0) | (self.side * stretch > 0)
        return jnp.where(works, self.stiffness * stretch**2 / 2, 0)


class Tension(PointElement):
    """A constant force between two points, along the line that joins them.

    **Arguments:** `a`, `b`: the two `Point`s; `tension`: positive pulls them
    together [N].

    **Raises:** ValueError for malformed arguments.
    """

    ends: Separation
    tension: Float[Array, ""]

    def __init__(self, a: Point, b: Point, tension: ArrayLike):
        self.ends = Separation(a, b)
        self.tension = real_array("tension", tension, ())

    def loads(self, t, q, qd, linkage):
        vector, length = (f(linkage, q) for f in (self.ends.vector, self.ends.length))
        pull = self.tension * vector / jnp.where(length > 0, length, 1)
        return Load(self.ends.a, pull), Load(self.ends.b, -pull)

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        """Of which the force is the slope: 0 where the points meet [J]."""
        return self.tension * self.ends.length(linkage, q)


class Wrench(PointElement):
    """A force and a moment from outside, on a point of a link.

    **Arguments:**

    - `point`: where.
    - `force`: (x, y) [N], or a function of time that returns it.
    - `moment`: counter-clockwise [N m], or a function of time that returns it.
    - `follows`: whether the force turns with the link: it is then (along, across).

    **Raises:** ValueError for malformed arguments.
    """

    point: Point
    force: Any
    moment: Any
    follows: Bool[Array, ""]

    def __init__(
        self,
        point: Point,
        force: ArrayLike | Callable[[Array], ArrayLike] = (0.0, 0.0),
        moment: ArrayLike | Callable[[Array], ArrayLike] = 0.0,
        *,
        follows: bool = False,
    ):
        instance("point", point, Point)
        self.point = point
        self.force = force if callable(force) else real_array("force", force, (2,))
        self.moment = moment if callable(moment) else real_array("moment", moment, ())
        instance("follows", follows, bool)
        self.follows = jnp.asarray(follows)

    def loads(self, t, q, qd, linkage):
        force, moment = self.force, self.moment
        if callable(force):
            force = real_array("force", force(t), (2,))
        if callable(moment):
            moment = real_array("moment", moment(t), ())
        turned = _turned(linkage, q, self.point.link, force)
        return (Load(self.point, jnp.where(self.follows, turned, force), moment),)
