"""Force elements at points of links: springs, constant forces, wrenches."""

from abc import abstractmethod
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float, Int, PyTree
from numpy.typing import ArrayLike

from ..base.checks import instance, refusal, whole_number
from ..linkage.fields import Condition, Part, Values, check_joints, field, of_kind
from ..linkage.frames import Frames, cross, length_of, plane_vector, scalar_frames
from ..linkage.linkage import Linkage, joints_of, per_joint, without_fixed
from ..linkage.topology import MOST_PAIRS
from ..mechanics.equations import Scalars
from .element import Element, ScalarElement
from .switches import switch


def pick(link: Array, choices: list[Array]) -> Array:
    """Selects a link's value from those of the ground and the links, NaN if beyond."""
    chosen: Any = jnp.nan
    for k, choice in enumerate(choices):
        chosen = jnp.where(link == k, choice, chosen)
    return chosen


def _link(link: int | Array) -> Array:
    number = whole_number("link", link, 0)  # also of another point, by `replace`
    if number > MOST_PAIRS:
        expected = f"0 (the ground) or a moving link, 1 to {MOST_PAIRS}"
        raise refusal("link", expected, link)
    return jax.device_put(np.array(number))


class Point(Part):
    """A point of a link or of the ground.

    **Arguments:**

    - `link`: 0 is the ground, 1, 2, ... are the moving links.
    - `along`, `across`: coordinates from the link's start, or the ground pivot [m]. The
      first axis is the link's vector A; the ground's is at the base angle.

    **Raises:** ValueError for another link or malformed numbers.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> import jax.numpy as jnp
    >>> fj.Point(1, along=1, across=0.5).position(arm, jnp.zeros(3)).tolist()
    [1.0, 0.5]
    """

    link: Array = eqx.field(converter=_link)
    along: Values = field((), unit="m", default=0.0)
    across: Values = field((), unit="m", default=0.0)

    def position(self, linkage: Linkage, q: ArrayLike) -> Float[Array, " 2"]:
        """Computes the point's position (x, y) from the ground pivot [m]."""
        check_joints("", self, linkage)
        positions = without_fixed(linkage, per_joint("q", q, linkage))
        place = self.place(scalar_frames(linkage, tuple(positions)))
        return jnp.stack([place.real, place.imag])

    def conditions_on(self, linkage):
        expected = f"0 (the ground) or a moving link, 1 to {joints_of(linkage)}"
        there = self.link <= joints_of(linkage)
        yield Condition(there, "link", expected, self.link)

    def place(self, frames: Frames) -> Complex[Array, ""]:
        """Computes the point's position x + iy [m]."""
        offset = plane_vector(self.along, self.across)
        start, direction = (pick(self.link, rows) for rows in frames[:2])
        return start + offset * direction

    def velocity(self, frames: Frames, qd: Scalars) -> Complex[Array, ""]:
        """Computes the point's velocity x + iy [m/s]."""
        # A unit force has the power of the velocity along it.
        along_x, along_y = (Load(self, force).efforts(frames) for force in (1, 1j))
        rows = ((x + 1j * y) * rate for x, y, rate in zip(along_x, along_y, qd))
        return reduce(add, rows)


class Load(NamedTuple):
    """A force and a moment on a point.

    - `force`: (x, y), or x + iy [N]; `moment`: counter-clockwise [N m].
    """

    point: Point
    force: Any
    moment: Array | float = 0.0

    def vector(self) -> Array:
        """Returns the force x + iy [N]."""
        try:
            x, y = self.force
        except TypeError:  # complex, as in the library's own loads
            return self.force
        return plane_vector(*(jnp.asarray(part, float) for part in (x, y)))

    def efforts(self, frames: Frames) -> tuple[Array, ...]:
        """Computes the joint efforts that do the same work [N or N m]."""
        # A joint moves only the links beyond it.
        place, link = self.point.place(frames), self.point.link
        efforts = work(frames, place, self.vector(), self.moment)
        return tuple(jnp.where(k < link, x, 0) for k, x in enumerate(efforts))


def work(
    frames: Frames, place: Array, force: Array, moment: Array | float = 0.0
) -> tuple[Array, ...]:
    """Power of a load beyond all joints, per unit of each joint's rate."""
    rows = zip(frames.revolute, frames.start[1:], frames.direction)
    return tuple(
        jnp.where(turns, cross(place - pivot, force) + moment, cross(link, force))
        for turns, pivot, link in rows
    )


class PointElement(ScalarElement):
    """A force element that acts on points of links or of the ground.

    A subclass implements `loads` [N and N m], which `joint_reactions` includes. In it,
    `point.place(frames)` is a point's position and `point.velocity(frames, qd)` its
    velocity, as complex numbers x + iy [m, m/s]. Forces may be complex, too.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> class Drag(fj.forces.PointElement):
    ...     def loads(self, scheduled, frames, qd):
    ...         tip = fj.Point(3, 1.0)
    ...         v = tip.velocity(frames, qd)
    ...         return (fj.forces.Load(tip, force=-2 * abs(v) * v),)
    >>> Drag()(0.0, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], arm).tolist()  # 3 m/s upwards
    [-54.0, -36.0, -18.0]
    """

    @abstractmethod
    def loads(self, scheduled: PyTree, frames: Frames, qd: Scalars) -> tuple[Load, ...]:
        """Returns the loads on points [N and N m], given the result of `schedule`."""

    def respond(self, scheduled, q, qd, linkage):
        frames = scalar_frames(linkage, q)
        efforts = [load.efforts(frames) for load in self.loads(scheduled, frames, qd)]
        return tuple(reduce(add, rows) for rows in zip(*efforts))

    def loads_on_points(self, t, q, qd, qdd, linkage):
        frames = scalar_frames(linkage, tuple(q))
        return self.loads(self.schedule(t, linkage), frames, tuple(qd))


class Between(Element):
    """An element between two points, along the line that joins them."""

    a: Point = of_kind(Point)
    b: Point = of_kind(Point)

    def vector(self, frames: Frames) -> Complex[Array, ""]:
        """Returns the vector from `a` to `b` [m]."""
        return self.b.place(frames) - self.a.place(frames)

    def length(self, linkage: Linkage, q: Array) -> Array:
        """Computes the points' distance [m], with derivative 0 where they meet."""
        return length_of(self.vector(scalar_frames(linkage, tuple(q))))

    def slopes(self, frames: Frames, vector: Array) -> tuple[Array, ...]:
        """Derivatives of length^2 / 2 in the joint positions."""
        works = enumerate(work(frames, self.a.place(frames), vector))
        beyond = lambda k, point: jnp.where(k < point.link, 1, 0)
        return tuple((beyond(k, self.b) - beyond(k, self.a)) * x for k, x in works)


def over(length: Array) -> Array:
    """Returns the reciprocal of a length; 1 where points meet."""
    return 1 / jnp.where(length > 0, length, 1)


class LineElement(Between, PointElement):
    """A force element that pulls two points together along the line that joins them."""

    @abstractmethod
    def pull(self, scheduled: PyTree, length: Array, rate: Array) -> Array:
        """Returns tension / length [N/m], given the length [m] and its rate [m/s]."""

    def _pull(self, scheduled, frames, qd) -> tuple[Array, tuple[Array, ...], Array]:
        vector = self.vector(frames)
        slopes = self.slopes(frames, vector)
        length = length_of(vector)
        rate = reduce(add, (slope * v for slope, v in zip(slopes, qd)))
        return vector, slopes, self.pull(scheduled, length, rate * over(length))

    def loads(self, scheduled, frames, qd):
        vector, _, pull = self._pull(scheduled, frames, qd)
        return Load(self.a, pull * vector), Load(self.b, -pull * vector)

    def respond(self, scheduled, q, qd, linkage):
        _, slopes, pull = self._pull(scheduled, scalar_frames(linkage, q), qd)
        return tuple(-pull * slope for slope in slopes)


_SIDES = {False: None, "cable": 1, "bumper": -1}


class SpringDamper(LineElement):
    """A spring and a damper between two points, along the line that joins them.

    The tension is stiffness * (length - rest_length) + damping * d(length)/dt. With a
    rest length, the force is 0 where the points meet.

    **Arguments:**

    - `a`, `b`: the two `Point`s.
    - `stiffness` [N/m], `damping` [N s/m], `rest_length` [m]: not negative.
    - `one_sided`: "cable" only pulls, beyond the rest length; "bumper" only pushes,
      below it; False, the default, does both.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> spring = fj.SpringDamper(fj.Point(0, 0, 2), fj.Point(1, 1), stiffness=20)
    >>> float(spring.potential_energy([0, 0, 0], arm))  # stretched to sqrt(5) m
    50.0
    """

    side: Int[Array, ""] | None  # 1: cable, -1: bumper, 0 or None: both
    stiffness: Values = field((), unit="N/m", minimum=0)
    damping: Values = field((), unit="N s/m", minimum=0)
    rest_length: Values = field((), unit="m", minimum=0)

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
        self.a, self.b = a, b
        self.stiffness, self.damping = stiffness, damping
        self.rest_length = rest_length
        if not isinstance(one_sided, str | bool) or one_sided not in _SIDES:
            raise refusal("one_sided", "False, 'cable' or 'bumper'", one_sided)
        side = _SIDES[one_sided]
        self.side = None if side is None else jax.device_put(np.array(side))

    def arguments(self) -> dict[str, Any]:
        fields = dict(vars(self))
        side = int(fields.pop("side") or 0)
        return fields | {"one_sided": {1: "cable", -1: "bumper"}.get(side, False)}

    def pull(self, scheduled, length, rate):
        # Without a rest length the pull is smooth even where the points meet.
        other = self.damping * rate - self.stiffness * self.rest_length
        pull = self.stiffness + other * over(length)
        if self.side is None:
            return pull
        tension = self.stiffness * (length - self.rest_length) + self.damping * rate
        both = self.side == 0
        on = switch(self.side * tension, True, both, continuous=True)
        on = switch(self.side * (length - self.rest_length), on, both)
        return jnp.where(on, pull, 0)

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        stretch = self.length(linkage, q) - self.rest_length
        energy = self.stiffness * stretch**2 / 2
        if self.side is None:
            return energy
        works = (self.side == 0) | (self.side * stretch > 0)
        return jnp.where(works, energy, 0)


class Tension(LineElement):
    """A constant force between two points, along the line that joins them.

    **Arguments:** `a`, `b`: the two `Point`s; `tension`: positive pulls them together
    [N].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> rope = fj.forces.Tension(fj.Point(0, 1, 2), fj.Point(1, 1), tension=10)
    >>> rope(0.0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], arm).tolist()  # straight up
    [10.0, 0.0, 0.0]
    """

    tension: Values = field((), unit="N")

    def pull(self, scheduled, length, rate):
        return self.tension * over(length)

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        return self.tension * self.length(linkage, q)


def _flag(follows: bool | Array | np.ndarray) -> Array:
    # An array comes from another wrench, by `replace`.
    if not isinstance(follows, Array | np.ndarray) or follows.dtype != bool:
        instance("follows", follows, bool)
    return follows if isinstance(follows, Array) else jax.device_put(np.array(follows))


class Wrench(PointElement):
    """An external force and moment on a point of a link.

    **Arguments:**

    - `point`: the `Point` of application.
    - `force`: (x, y) [N]; `moment`: counter-clockwise [N m]. Each may be a function of
      time.
    - `follows`: whether the force is (along, across) and turns with the link.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> push = fj.Wrench(fj.Point(3, 1), force=[0, 10], moment=1)
    >>> push(0.0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], arm).tolist()  # levers 3, 2, 1 m
    [31.0, 21.0, 11.0]
    """

    point: Point = of_kind(Point)
    force: Any = field((2,), unit="N", function=True, default=(0.0, 0.0))
    moment: Any = field((), unit="N m", function=True, default=0.0)
    follows: bool | Array = eqx.field(converter=_flag, default=False, kw_only=True)

    def schedule(self, t, linkage):
        """Returns the force and the moment at a time."""
        force, moment = self.value_of("force", t), self.value_of("moment", t)
        return plane_vector(force[0], force[1]), moment

    def loads(self, scheduled, frames, qd):
        force, moment = scheduled
        along = pick(self.point.link, frames.direction)
        force = jnp.where(self.follows, force * along, force)
        return (Load(self.point, force, moment),)
