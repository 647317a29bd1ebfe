"""Ranges of motion and friction of joints: outside the paper's model."""

from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .forces import ScalarElement
from .validation import concrete, real_array


class JointStops(ScalarElement):
    """Stops at the ends of the joints' ranges: stiff springs that push one way.

    The force grows smoothly from nothing, and with the speed of the impact: it is
    stiffness * p * (1 + damping * dp/dt) at a penetration p, never less than 0. The
    penetration is rounded off over `smoothing`: at the end of the range itself it is
    half of that.

    **Arguments:** all in joint order, one per joint or one for all.

    - `lower`, `upper`: ends of the range [m or rad]; may be infinite.
    - `stiffness`: positive [N/m or N m/rad].
    - `damping`: not negative [s/m or s/rad].
    - `smoothing`: positive [m or rad].

    **Raises:** ValueError for malformed arguments, and unless lower < upper.
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

    def respond(self, scheduled, q, qd, linkage):
        rows = zip(
            q, qd, self.lower, self.upper, self.stiffness, self.damping, self.smoothing
        )
        return tuple(
            _push(low - x, -rate, k, d, width) - _push(x - high, rate, k, d, width)
            for x, rate, low, high, k, d, width in rows
        )


def _push(depth, rate, stiffness, damping, width):
    """Of a stop that is penetrated to a depth, negative outside of it."""
    far = depth < -1e6 * width  # a range without an end, among others
    near = jnp.where(far, 0, depth)
    root = jnp.sqrt(near**2 + width**2)
    # Rounded: width / 2 at depth 0, and less than width^2 / |depth| outside.
    deep, shallow = (root + near) / 2, width**2 / (2 * (root + jnp.abs(near)))
    rounded = jnp.where(near >= 0, deep, shallow)
    # d(rounded)/d(depth) times the rate.
    closing = rate * (1 + near / root) / 2
    force = stiffness * rounded * jnp.maximum(1 + damping * closing, 0)
    return jnp.where(far, 0, force)


class JointFriction(ScalarElement):
    """Coulomb friction of the joints, rounded off around standstill.

    The effort is -level * tanh(qd / speed): joints creep under loads below the level,
    at a fraction of `speed`. The smaller that is, the stiffer the equations.

    **Arguments:** one per joint or one for all.

    - `level`: not negative [N or N m].
    - `speed`: positive [m/s or rad/s].

    **Raises:** ValueError for malformed arguments.
    """

    level: Float[Array, " joint"]
    speed: Float[Array, " joint"]

    def __init__(self, level: ArrayLike, speed: ArrayLike = 1e-2):
        self.level = real_array("level", level, (3,), minimum=0, broadcast=True)
        self.speed = real_array("speed", speed, (3,), above=0, broadcast=True)

    def respond(self, scheduled, q, qd, linkage):
        return tuple(
            -level * jnp.tanh(rate / speed)
            for level, speed, rate in zip(self.level, self.speed, qd)
        )
