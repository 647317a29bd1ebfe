"""Paths of the tip."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import instance, real_array
from ..base.known_values import at_once
from ..base.trigonometry import sincos
from ..linkage.fields import Part, Values, default, field


class Path(Part):
    """A curve in the plane [m]; a subclass defines `point` and `middle`.

    >>> import fdof_jax as fj
    >>> import jax.numpy as jnp
    >>> class Parabola(fj.references.Path):
    ...     middle = jnp.array([-4.0, 2.0])
    ...     def point(self, share):
    ...         return jnp.stack([share - 4.5, 2 + share**2])
    >>> fj.TipTask(Parabola(), fj.references.Travel(1.0)).tip(0.5).tolist()
    [-4.0, 2.25]
    """

    middle = default(lambda self: None)  # a point (x, y) amid the curve [m]

    @abstractmethod
    def point(self, share: Array) -> Array:
        """Returns the point (x, y) at a share of the way, 0 to 1 or per lap [m]."""


class Line(Path):
    """A straight line.

    **Arguments:** `start`, `end`: points (x, y) [m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> fj.references.Line([0, 0], [2, 4]).point(0.25).tolist()
    [0.5, 1.0]
    """

    start: Values = field((2,), unit="m")
    end: Values = field((2,), unit="m")

    @property
    def middle(self) -> Array:
        return (self.start + self.end) / 2

    def point(self, share):
        return self.start + share * (self.end - self.start)


class _Closed(Path):
    """A closed curve around `middle` with two `sizes`, turned by `tilt`."""

    middle: Values = field((2,), unit="m")
    sizes: Values = field((2,), unit="m", minimum=0)
    tilt: Values = field((), unit="rad", default=0.0, kw_only=True)

    def _placed(self, along: Array, across: Array) -> Array:
        sin, cos = sincos(self.tilt)
        a, b = self.sizes[0] * along, self.sizes[1] * across
        return self.middle + jnp.stack([a * cos - b * sin, a * sin + b * cos])


class Ellipse(_Closed):
    """An ellipse, counter-clockwise from the end of its first axis.

    **Arguments:** `middle`: (x, y) [m]; `sizes`: the half axes, not negative [m];
    `tilt`: angle of the first axis [rad].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> ellipse = fj.references.Ellipse([1, 0], [2, 1])
    >>> ellipse.point(0.25).tolist()  # a quarter of the way round
    [1.0, 1.0]
    """

    def point(self, share):
        sin, cos = sincos(2 * np.pi * share)
        return self._placed(cos, sin)


class FigureEight(_Closed):
    """A figure eight lying on its side, starting at its crossing.

    **Arguments:** `middle`: the crossing (x, y) [m]; `sizes`: half the length and half
    the height, not negative [m]; `tilt`: angle of the long axis [rad].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> fj.references.FigureEight([0, 0], [2, 1]).point(0.25).tolist()
    [2.0, 0.0]
    """

    def point(self, share):
        sin, cos = sincos(2 * np.pi * share)
        return self._placed(sin, 2 * sin * cos)


class Spline(Path):
    """A cubic spline through points, equally spaced in the share of the way.

    **Arguments:** `points`: three or more (x, y) [m]; `closed`: whether the spline
    returns to the first point. An open one is straight at its ends.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> fj.references.Spline([[0, 0], [1, 1], [2, 0]]).point(0.5).tolist()
    [1.0, 1.0]
    """

    points: Float[Array, "n 2"]
    bends: Float[Array, "n 2"]  # second derivatives per interval squared
    closed: bool = eqx.field(static=True)

    def __init__(self, points: ArrayLike, *, closed: bool = False):
        self.points = real_array("points", points, (None, 2))
        instance("closed", closed, bool)
        self.closed = closed
        count = len(self.points)
        if count < 3:
            raise ValueError(f"points: expected three or more, got {count}.")
        self.bends = _bends(self.points, closed)

    @property
    def middle(self) -> Array:
        return self.points.mean(axis=0)

    def point(self, share):
        count = len(self.points)
        if self.closed:
            place = jnp.mod(share, 1) * count
            first = jnp.minimum(jnp.floor(place), count - 1)
        else:
            place = share * (count - 1)
            first = jnp.clip(jnp.floor(place), 0, count - 2)
        b, k = place - first, first.astype(int)
        a, after = 1 - b, (k + 1) % count
        bend = (a**3 - a) * self.bends[k] + (b**3 - b) * self.bends[after]
        return a * self.points[k] + b * self.points[after] + bend / 6


@at_once
def _bends(points: Array, closed: bool) -> Array:
    """Solves b[k-1] + 4 b[k] + b[k+1] = 6 d2[k]: slopes of neighbours meet."""
    before, after = (jnp.roll(points, k, axis=0) for k in (1, -1))
    right = 6 * (before - 2 * points + after)
    if not closed:  # no bend at the ends: half of a closed one that turns over
        right = right.at[jnp.array([0, -1])].set(0)
        right = jnp.concatenate([right, -right[-2:0:-1]])
    waves = jnp.fft.rfft(right, axis=0)
    turns = 2 * np.pi * np.arange(len(waves))[:, None] / len(right)
    waves = waves / (4 + 2 * np.cos(turns)).astype(waves.dtype)
    return jnp.fft.irfft(waves, len(right), axis=0)[: len(points)]
