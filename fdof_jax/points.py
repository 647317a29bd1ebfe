"""Points of links, and what pulls or pushes at them.

Written in scalars, which fuse with the equations of motion; vectors are complex.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Complex, Float, Int
from numpy.typing import ArrayLike

from .forces import ScalarElement, jumps_of
from .linkage import Linkage, real_joints
from .reduced_equations import Scalars
from .trigonometry import sincos
from .validation import instance, real_array, whole_number


class Frames(NamedTuple):
    """Starts and directions of the ground and the moving links: four scalars each.

    `turning`: whether the joint before each moving link is revolute.
    """

    start: list[Array]
    direction: list[Array]
    turning: Scalars


def frames_of(linkage: Linkage, q: Scalars) -> Frames:
    """The frames at joint positions."""
    turning = real_joints(linkage.ef)
    angle, start = linkage.base_angle, [jnp.zeros((), complex)]
    direction = []
    for k, turns in enumerate(turning):
        direction.append(_direction(angle))
        # The length A runs along a link, the slide B across it.
        slide = jnp.where(turns, linkage.locked[k], q[k])
        step = jax.lax.complex(linkage.length[k], slide)
        start.append(start[k] + step * direction[k])
        angle = angle + jnp.where(turns, q[k], linkage.locked[k])
    return Frames(start, [*direction, _direction(angle)], turning)


def _direction(angle: Array) -> Array:
    sin, cos = sincos(angle)
    return jax.lax.complex(cos, sin)


def dot(a: Array, b: Array) -> Array:
    """The dot product of two vectors of the plane."""
    return a.real * b.real + a.imag * b.imag


def cross(a: Array, b: Array) -> Array:
    """The cross product of two vectors of the plane."""
    return a.real * b.imag - a.imag * b.real


def _pick(link: Array, choices: list[Array]) -> Array:
    """The one of the ground and three links."""
    chosen = choices[0]
    for k in (1, 2, 3):
        chosen = jnp.where(link == k, choices[k], chosen)
    return chosen


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

    def position(self, linkage: Linkage, q: ArrayLike) -> Float[Array, " 2"]:
        """Where it is: (x, y), from the ground pivot [m]."""
        place = self.place(frames_of(linkage, tuple(real_array("q", q, (3,)))))
        return jnp.stack([place.real, place.imag])

    def place(self, frames: Frames) -> Complex[Array, ""]:
        """Where it is, x + iy [m]."""
        offset = jax.lax.complex(self.along, self.across)
        start, direction = (_pick(self.link, rows) for rows in frames[:2])
        return start + offset * direction


class Load(NamedTuple):
    """A force and a moment on a point.

    - `force`: x + iy, a complex number [N]; `moment`: counter-clockwise [N m].
    """

    point: Point
    force: Array
    moment: Any = 0.0

    def efforts(self, frames: Frames) -> tuple[Array, ...]:
        """The joint efforts that do the same work [N or N m].

        A joint turns what lies beyond it, or slides it across the link before.
        """
        about_origin = cross(self.point.place(frames), self.force) + self.moment
        efforts = _work(frames, self.force, about_origin)
        return tuple(
            jnp.where(k < self.point.link, effort, 0)
            for k, effort in enumerate(efforts)
        )


def _work(frames: Frames, force: Array, about_origin: Array) -> tuple[Array, ...]:
    """Of a force and its moment about the origin, per unit of each joint's rate."""
    rows = zip(frames.turning, frames.start[1:], frames.direction)
    return tuple(
        jnp.where(turns, about_origin - cross(pivot, force), cross(link, force))
        for turns, pivot, link in rows
    )


class PointElement(ScalarElement):
    """A force element that acts on points of links or of the ground.

    A subclass implements `loads` [N and N m]. Unlike efforts in the joints, which pass
    through them, these loads are carried by the bearings: see `joint_reactions`.
    """

    @abstractmethod
    def loads(self, scheduled: Any, frames: Frames, qd: Scalars) -> tuple[Load, ...]:
        """What it does to the points, given what `schedule` returned."""

    def respond(self, scheduled, q, qd, linkage):
        frames = frames_of(linkage, q)
        efforts = [load.efforts(frames) for load in self.loads(scheduled, frames, qd)]
        return tuple(reduce(add, rows) for rows in zip(*efforts))


class Separation(eqx.Module):
    """Two points, and the line between them."""

    a: Point
    b: Point

    def __init__(self, a: Point, b: Point):
        instance("a", a, Point)
        instance("b", b, Point)
        self.a, self.b = a, b

    def vector(self, frames: Frames) -> Complex[Array, ""]:
        """From `a` to `b` [m]."""
        return self.b.place(frames) - self.a.place(frames)

    def length(self, linkage: Linkage, q: Array) -> Array:
        """Their distance [m]; its derivative is 0 where it is 0."""
        return length_of(self.vector(frames_of(linkage, tuple(q))))

    def slopes(self, frames: Frames, vector: Array) -> tuple[Array, ...]:
        """Derivatives of half of the square of the length: of the length, times it."""
        works = _work(frames, vector, cross(self.a.place(frames), vector))
        beyond = lambda k, point: jnp.where(k < point.link, 1, 0)
        return tuple(
            (beyond(k, self.b) - beyond(k, self.a)) * work
            for k, work in enumerate(works)
        )


def length_of(vector: Array) -> Array:
    """Its length; 0 with derivative 0 if it has none."""
    square = vector.real**2 + vector.imag**2
    apart = square > 0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)


def over(length: Array) -> Array:
    """The reciprocal; 1 where points meet and have no line."""
    return 1 / jnp.where(length > 0, length, 1)


class LineElement(PointElement):
    """A force element that pulls two points together along the line that joins them.

    A subclass implements `pull`.
    """

    ends: eqx.AbstractVar[Separation]

    @abstractmethod
    def pull(self, scheduled: Any, length: Array, rate: Array) -> Array:
        """The tension over the length [N/m], given that [m] and its rate [m/s]."""

    def _pull(self, scheduled, frames, qd) -> tuple[Array, tuple[Array, ...], Array]:
        vector = self.ends.vector(frames)
        slopes = self.ends.slopes(frames, vector)
        length = length_of(vector)
        rate = reduce(add, (slope * v for slope, v in zip(slopes, qd)))
        return vector, slopes, self.pull(scheduled, length, rate * over(length))

    def loads(self, scheduled, frames, qd):
        vector, _, pull = self._pull(scheduled, frames, qd)
        return Load(self.ends.a, pull * vector), Load(self.ends.b, -pull * vector)

    def respond(self, scheduled, q, qd, linkage):
        _, slopes, pull = self._pull(scheduled, frames_of(linkage, q), qd)
        return tuple(-pull * slope for slope in slopes)


class SpringDamper(LineElement):
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

    def pull(self, scheduled, length, rate):
        tension = self.stiffness * (length - self.rest_length) + self.damping * rate
        beyond = self.side * (length - self.rest_length) > 0
        works = (self.side == 0) | (beyond & (self.side * tension > 0))
        # The pull of a spring of no rest length is smooth also where the points meet.
        other = self.damping * rate - self.stiffness * self.rest_length
        return jnp.where(works, self.stiffness + other * over(length), 0)

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        """The energy of the spring [J]."""
        stretch = self.ends.length(linkage, q) - self.rest_length
        works = (self.side == 0) | (self.side * stretch > 0)
        return jnp.where(works, self.stiffness * stretch**2 / 2, 0)


class Tension(LineElement):
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

    def pull(self, scheduled, length, rate):
        return self.tension * over(length)

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

    @property
    def jump_ts(self) -> Array | None:
        """The times at which the functions say that they jump, if they do."""
        return jumps_of(self.force, self.moment)

    def schedule(self, t, linkage):
        """Force and moment at a time."""
        force, moment = self.force, self.moment
        if callable(force):
            force = real_array("force", force(t), (2,))
        if callable(moment):
            moment = real_array("moment", moment(t), ())
        return jax.lax.complex(force[0], force[1]), moment

    def loads(self, scheduled, frames, qd):
        force, moment = scheduled
        along = _pick(self.point.link, frames.direction)
        return (
            Load(self.point, jnp.where(self.follows, force * along, force), moment),
        )
