"""Stops and friction of joints, which the paper's model does not have."""

from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import concrete, real_array
from ..linkage.linkage import Linkage
from .element import ScalarElement


class JointStops(ScalarElement):
    """Stops at the ends of the joints' ranges: stiff springs that push one way.

    At a penetration p the force is stiffness * p * (1 + damping * dp/dt), and never
    less than 0. Within `smoothing` of the end of the range, on both sides, p is rounded
    off to a parabola; at the end itself p is a quarter of `smoothing`.

    **Arguments:** all in joint order, one per joint or one for all.

    - `lower`, `upper`: ends of the range [m or rad]; may be infinite.
    - `stiffness`: positive [N/m or N m/rad].
    - `damping`: not negative [s/m or s/rad].
    - `smoothing`: positive [m or rad].

    **Raises:** ValueError for malformed arguments, and unless lower < upper.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> stops = fj.JointStops(-1.0, 1.0, stiffness=1e4)
    >>> stops(0.0, [0.0, 1.01, -1.01], [0, 0, 0], arm).tolist()
    [0.0, -100.0, 100.0]
    """

    lower: Float[Array, " joint"]
    upper: Float[Array, " joint"]
    stiffness: Float[Array, " joint"]
    damping: Float[Array, " joint"]
    smoothing: Float[Array, " joint"]

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        stiffness: ArrayLike = 1e4,
        damping: ArrayLike = 0.0,
        smoothing: ArrayLike = 1e-3,
    ):
        wide: dict[str, Any] = dict(finite=False, broadcast=True)
        self.lower = real_array("lower", lower, (3,), **wide)
        self.upper = real_array("upper", upper, (3,), **wide)
        low, high = concrete(self.lower), concrete(self.upper)
        if low is not None and high is not None and not (low < high).all():
            raise ValueError(
                f"lower: expected less than upper, got {low.tolist()} and "
                f"{high.tolist()}."
            )
        positive: dict[str, Any] = dict(above=0, broadcast=True)
        self.stiffness = real_array("stiffness", stiffness, (3,), **positive)
        self.damping = real_array("damping", damping, (3,), minimum=0, broadcast=True)
        self.smoothing = real_array("smoothing", smoothing, (3,), **positive)

    def possible(self) -> Array:
        """Returns whether ranges are not empty and values have the right sign."""
        ranges = (self.lower < self.upper) & (self.damping >= 0)
        return (ranges & (self.stiffness > 0) & (self.smoothing > 0)).all()

    def respond(self, scheduled, q, qd, linkage):
        rows = zip(
            q, qd, self.lower, self.upper, self.stiffness, self.damping, self.smoothing
        )
        return tuple(
            _push(low - x, -rate, k, d, width) - _push(x - high, rate, k, d, width)
            for x, rate, low, high, k, d, width in rows
        )

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        """Computes the energy of the springs [J]."""
        below = _stored(self.lower - q, self.smoothing)
        above = _stored(q - self.upper, self.smoothing)
        return jnp.sum(self.stiffness * (below + above))


def _push(depth, rate, stiffness, damping, width):
    """Force of a stop at a depth, which is negative outside of the stop."""
    penetration, slope = _penetration(depth, width)
    return stiffness * penetration * jnp.maximum(1 + damping * slope * rate, 0)


def _penetration(depth, width):
    """Rounded depth and its derivative, 0 before the parabola and 1 beyond it."""
    near, beyond = _parts(depth, width)
    return near**2 / (4 * width) + beyond, near / (2 * width)


def _parts(depth, width):
    """Splits the depth into the parts within the parabola and beyond it."""
    # jnp.clip would multiply the derivative in an infinite end of a range by 0.
    deep = depth > width
    near = jnp.where(deep, 2 * width, jnp.where(depth < -width, 0, depth + width))
    return near, jnp.where(deep, depth - width, 0)


def _stored(depth, width):
    """Integral of the rounded depth."""
    near, beyond = _parts(depth, width)
    return near**3 / (12 * width) + beyond * (beyond / 2 + width)


class JointFriction(ScalarElement):
    """Coulomb friction of the joints, rounded off around standstill.

    The effort is -level * tanh(qd / speed). Under loads below the level, joints creep
    at a fraction of `speed`. The smaller `speed`, the stiffer the equations.

    **Arguments:** one per joint or one for all.

    - `level`: not negative [N or N m].
    - `speed`: positive [m/s or rad/s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.JointFriction(5)(0.0, [0, 0, 0], [0.0, 0.01, -1.0], arm).tolist()
    [0.0, -3.808, 5.0]
    """

    level: Float[Array, " joint"]
    speed: Float[Array, " joint"]

    def __init__(self, level: ArrayLike, speed: ArrayLike = 1e-2):
        self.level = real_array("level", level, (3,), minimum=0, broadcast=True)
        self.speed = real_array("speed", speed, (3,), above=0, broadcast=True)

    def possible(self) -> Array:
        """Returns whether levels are not negative and speeds positive."""
        return ((self.level >= 0) & (self.speed > 0)).all()

    def respond(self, scheduled, q, qd, linkage):
        return tuple(
            -level * jnp.tanh(rate / speed)
            for level, speed, rate in zip(self.level, self.speed, qd)
        )
