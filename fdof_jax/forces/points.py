"""Points of links, and the joint efforts of loads on points.

The code uses scalars, which fuse with the equations of motion, and complex numbers as
vectors of the plane.
"""

from abc import abstractmethod
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from ..base.checks import is_traced, shown, whole_number
from ..linkage.fields import Condition, Part, Values, check_joints, field, of_kind
from ..linkage.frames import Frames, cross, frames, length_of, scalar_frames
from ..linkage.linkage import Linkage, joints_of, per_joint, without_fixed
from ..linkage.topology import MOST_PAIRS
from ..mechanics.equations import Scalars
from .element import ScalarElement


def pick(link: Array, choices: list[Array]) -> Array:
    """Selects a link's value from those of the ground and the links, NaN if beyond."""
    chosen: Any = jnp.nan
    for k, choice in enumerate(choices):
        chosen = jnp.where(link == k, choice, chosen)
    return chosen


def _link(link: Any) -> Array:
    if isinstance(link, Array) and not is_traced(link) and link.shape == ():
        link = link.item()  # of another point, by `replace`
    if whole_number("link", link, 0) > MOST_PAIRS:
        raise ValueError(
            f"link: expected 0 (the ground) or a moving link, 1 to {MOST_PAIRS}, got "
            f"{shown(link)}."
        )
    return jax.device_put(np.array(link))


class Point(Part):
    """A point of a link or of the ground.

    **Arguments:**

    - `link`: 0 is the ground, 1, 2, ... are the moving links.
    - `along`, `across`: coordinates in the link's own frame [m]. Its origin is the
      link's characteristic point, or the ground pivot. Its first axis is the link's
      vector A; the ground's first axis is at the base angle.

    **Raises:** ValueError for another link or malformed numbers.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> import jax.numpy as jnp
    >>> fj.Point(1, along=1, across=0.5).position(arm, jnp.zeros(3)).tolist()
    [1.0, 0.5]
    """

    link: Any = eqx.field(converter=_link)
    along: Values = field((), unit="m", default=0.0)
    across: Values = field((), unit="m", default=0.0)

    def position(self, linkage: Linkage, q: ArrayLike) -> Float[Array, " 2"]:
        """Computes the point's position (x, y) from the ground pivot [m]."""
        check_joints("", self, linkage)
        q = without_fixed(linkage, per_joint("q", q, linkage))
        place = self.place(frames(linkage, q))
        return jnp.stack([place.real, place.imag])

    def conditions_on(self, linkage):
        expected = f"0 (the ground) or a moving link, 1 to {joints_of(linkage)}"
        there = self.link <= joints_of(linkage)
        yield Condition(there, "link", expected, self.link)

    def place(self, frames: Frames) -> Complex[Array, ""]:
        """Computes the point's position x + iy [m]."""
        offset = jax.lax.complex(self.along, self.across)
        start, direction = (pick(self.link, rows) for rows in frames[:2])
        return start + offset * direction


class Load(NamedTuple):
    """A force and a moment on a point.

    - `force`: (x, y) [N]; `moment`: counter-clockwise [N m].
    """

    point: Point
    force: Any
    moment: Any = 0.0

    def vector(self) -> Array:
        """Returns the force x + iy [N]."""
        try:
            x, y = self.force
        except TypeError:  # complex, as in the library's own loads
            return self.force
        return jax.lax.complex(*(jnp.asarray(part, float) for part in (x, y)))

    def efforts(self, frames: Frames) -> tuple[Array, ...]:
        """Computes the joint efforts that do the same work [N or N m]."""
        # A joint moves only the links beyond it.
        efforts = work(frames, self.point.place(frames), self.vector(), self.moment)
        return tuple(
            jnp.where(k < self.point.link, effort, 0)
            for k, effort in enumerate(efforts)
        )


def work(
    frames: Frames, place: Array, force: Array, moment: Any = 0.0
) -> tuple[Array, ...]:
    """Power of a load beyond all joints, per unit of each joint's rate."""
    rows = zip(frames.revolute, frames.start[1:], frames.direction)
    return tuple(
        jnp.where(turns, cross(place - pivot, force) + moment, cross(link, force))
        for turns, pivot, link in rows
    )


class PointElement(ScalarElement):
    """A force element that acts on points of links or of the ground.

    A subclass implements `loads` [N and N m]. The bearings carry these loads, unlike
    efforts in the joints: see `joint_reactions`.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> class Weight(fj.forces.PointElement):
    ...     def loads(self, scheduled, frames, qd):
    ...         tip = fj.Point(3, 1.0)
    ...         return (fj.forces.Load(tip, force=(0, -10)),)  # downwards
    >>> Weight()(0.0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], arm).tolist()
    [-30.0, -20.0, -10.0]
    """

    @abstractmethod
    def loads(self, scheduled: Any, frames: Frames, qd: Scalars) -> tuple[Load, ...]:
        """Returns the loads on points [N and N m], given the result of `schedule`."""

    def respond(self, scheduled, q, qd, linkage):
        frames = scalar_frames(linkage, q)
        efforts = [load.efforts(frames) for load in self.loads(scheduled, frames, qd)]
        return tuple(reduce(add, rows) for rows in zip(*efforts))

    def loads_on_points(self, t, q, qd, qdd, linkage):
        scheduled = self.schedule(t, linkage)
        return self.loads(scheduled, frames(linkage, q), tuple(qd))


class Separation(Part):
    """Two points and the line between them."""

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
        works = work(frames, self.a.place(frames), vector)
        beyond = lambda k, point: jnp.where(k < point.link, 1, 0)
        return tuple(
            (beyond(k, self.b) - beyond(k, self.a)) * work
            for k, work in enumerate(works)
        )


def arguments_of(element: Any) -> dict[str, Any]:
    """Returns the fields of an element, with its points in the place of its `ends`."""
    fields = dict(vars(element))
    return vars(fields.pop("ends")) | fields


def over(length: Array) -> Array:
    """Reciprocal of a length; 1 where points meet and have no line."""
    return 1 / jnp.where(length > 0, length, 1)
