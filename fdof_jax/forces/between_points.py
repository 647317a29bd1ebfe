"""Force elements at points of links: springs, constant forces, wrenches."""

from abc import abstractmethod
from functools import reduce
from operator import add
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Int
from numpy.typing import ArrayLike

from ..base.checks import instance, refusal
from ..linkage.fields import Values, field, of_kind, value_of
from ..linkage.frames import length_of, scalar_frames
from ..linkage.linkage import Linkage
from .points import Load, Point, PointElement, Separation, arguments_of, over, pick
from .switches import switch


class LineElement(PointElement):
    """A force element that pulls two points together along the line that joins them."""

    ends: eqx.AbstractVar[Separation]

    def arguments(self) -> dict[str, Any]:
        return arguments_of(self)

    @abstractmethod
    def pull(self, scheduled: Any, length: Array, rate: Array) -> Array:
        """Returns tension / length [N/m], given the length [m] and its rate [m/s]."""

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
        _, slopes, pull = self._pull(scheduled, scalar_frames(linkage, q), qd)
        return tuple(-pull * slope for slope in slopes)


_SIDES = {False: None, "cable": 1, "bumper": -1}


class SpringDamper(LineElement):
    """A spring and a damper between two points, along the line that joins them.

    The tension is stiffness * (length - rest_length) + damping * d(length)/dt. With a
    rest length, points that meet have no line, and the force is 0 there.

    **Arguments:**

    - `a`, `b`: the two `Point`s.
    - `stiffness` [N/m], `damping` [N s/m], `rest_length` [m]: not negative.
    - `one_sided`: "cable" only pulls and "bumper" only pushes; neither acts on the
      other side of the rest length. False: the element pulls and pushes.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> spring = fj.SpringDamper(fj.Point(0, 0, 2), fj.Point(1, 1), stiffness=20)
    >>> float(spring.potential_energy([0, 0, 0], arm))  # stretched to sqrt(5) m
    50.0
    """

    ends: Separation
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
        self.ends = Separation(a, b)
        self.stiffness, self.damping = stiffness, damping
        self.rest_length = rest_length
        if not isinstance(one_sided, str | bool) or one_sided not in _SIDES:
            raise refusal("one_sided", "False, 'cable' or 'bumper'", one_sided)
        side = _SIDES[one_sided]
        self.side = None if side is None else jax.device_put(np.array(side))

    def arguments(self) -> dict[str, Any]:
        fields = super().arguments()
        side = fields.pop("side")
        number = None if side is None else int(side)
        words = {number: word for word, number in _SIDES.items()}
        return fields | {"one_sided": words[number]}

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
        """Computes the energy of the spring [J]."""
        stretch = self.ends.length(linkage, q) - self.rest_length
        energy = self.stiffness * stretch**2 / 2
        if self.side is None:
            return energy
        works = (self.side == 0) | (self.side * stretch > 0)
        return jnp.where(works, energy, 0)


class Tension(LineElement):
    """A constant force between two points, along the line that joins them.

    Its potential energy is tension times length, which `energy` includes.

    **Arguments:** `a`, `b`: the two `Point`s; `tension`: positive pulls them
    together [N].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> rope = fj.forces.Tension(fj.Point(0, 1, 2), fj.Point(1, 1), tension=10)
    >>> rope(0.0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], arm).tolist()  # straight up
    [10.0, 0.0, 0.0]
    """

    ends: Separation
    tension: Values = field((), unit="N")

    def __init__(self, a: Point, b: Point, tension: ArrayLike):
        self.ends = Separation(a, b)
        self.tension = tension

    def pull(self, scheduled, length, rate):
        return self.tension * over(length)

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        """Computes tension times length [J], whose slope is the force."""
        return self.tension * self.ends.length(linkage, q)


def _flag(follows: Any) -> Array:
    if isinstance(follows, Array) and follows.dtype == bool:
        return follows  # of another wrench, by `replace`
    instance("follows", follows, bool)
    return jax.device_put(np.array(follows))


class Wrench(PointElement):
    """An external force and moment on a point of a link.

    **Arguments:**

    - `point`: the `Point` of application.
    - `force`: (x, y) [N], or a function of time that returns it.
    - `moment`: counter-clockwise [N m], or a function of time that returns it.
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
        force, moment = value_of(self, "force", t), value_of(self, "moment", t)
        return jax.lax.complex(force[0], force[1]), moment

    def loads(self, scheduled, frames, qd):
        force, moment = scheduled
        along = pick(self.point.link, frames.direction)
        return (
            Load(self.point, jnp.where(self.follows, force * along, force), moment),
        )
