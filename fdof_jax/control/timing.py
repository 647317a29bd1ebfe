"""How far along a path, and when: profiles of point-to-point motions, and laps."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import concrete, one_of, real_array
from ..xla.array_namespace import namespace

_MOST_TURN = 250  # that 48 nodes per piece resolve [rad]
RAMP = 0.25  # of a trapezoidal profile: the share of its time in which it speeds up


def _trapezoidal(x: Array) -> Array:
    xp = namespace(x)
    scale = 2 * RAMP * (1 - RAMP)
    cruising = xp.where(
        x > 1 - RAMP, 1 - (1 - x) ** 2 / scale, (x - RAMP / 2) / (1 - RAMP)
    )
    return xp.where(x < RAMP, x**2 / scale, cruising)


# The share of the way done at a share of the time, both from 0 to 1.
PROFILES: dict[str, Callable[[Array], Array]] = {
    "harmonic": lambda x: (1 - namespace(x).cos(np.pi * x)) / 2,
    "cycloidal": lambda x: x - namespace(x).sin(2 * np.pi * x) / (2 * np.pi),
    "quintic": lambda x: x**3 * (10 - 15 * x + 6 * x**2),
    "trapezoidal": _trapezoidal,
}


class Travel(eqx.Module):
    """From the start of a path to its end in a given time: the share of the way.

    **Arguments:**

    - `duration`: positive [s].
    - `begin`: when it starts [s]. Before, it stands at the start.
    - `profile`: "harmonic" (cosine of the way), "cycloidal" (sine of the acceleration),
      "quintic" (no acceleration at both ends) or "trapezoidal" (of the velocity, a
      quarter of the time each speeding up and slowing down).
    - `shock`: share of the way done at constant velocity. The velocity then jumps at
      both ends; see `shock_against`.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> harmonic = fj.Travel(2.0, profile="harmonic")
    >>> [float(harmonic(t)) for t in (0, 0.5, 1, 3)]
    [0.0, 0.146, 0.5, 1.0]
    """

    duration: Float[Array, ""]
    begin: Float[Array, ""]
    shock: Float[Array, ""]
    profile: str = eqx.field(static=True)

    def __init__(
        self,
        duration: ArrayLike,
        *,
        begin: ArrayLike = 0.0,
        profile: str = "quintic",
        shock: ArrayLike = 0.0,
    ):
        self.duration = real_array("duration", duration, (), above=0)
        self.begin = real_array("begin", begin, ())
        self.shock = real_array("shock", shock, ())
        self.profile = one_of("profile", profile, tuple(PROFILES))

    def __call__(self, t: Array) -> Array:
        """The share of the way at a time, from 0 to 1."""
        x = (t - self.begin) / self.duration
        # At a jump what comes after it counts: the derivative of jnp.clip is the mean.
        xp = namespace(x)
        x = xp.where(x < 0, 0, xp.where(x < 1, x, 1))
        return (1 - self.shock) * PROFILES[self.profile](x) + self.shock * x

    @property
    def jump_ts(self) -> Array:
        """When velocity or acceleration jump [s]."""
        shares = [0.0, 1.0]
        if self.profile == "trapezoidal":
            shares = [0.0, RAMP, 1 - RAMP, 1.0]
        return self.begin + self.duration * np.array(shares, self.duration.dtype)


class Laps(eqx.Module):
    """Around a closed path at constant speed of its parameter, for ever.

    **Arguments:** `period`: of one lap, backwards if negative, not zero [s]; `phase`:
    where it starts, as a share of a lap.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> [float(fj.Laps(period=4)(t)) for t in (1, 4, 10)]
    [0.25, 1.0, 2.5]
    """

    period: Float[Array, ""]
    phase: Float[Array, ""]

    def __init__(self, period: ArrayLike, *, phase: ArrayLike = 0.0):
        self.period = real_array("period", period, ())
        if concrete(self.period) == 0:
            raise ValueError(f"period: expected not zero, got {period!r}.")
        self.phase = real_array("phase", phase, ())

    def __call__(self, t: Array) -> Array:
        return self.phase + t / self.period


def shock_against(travel: Travel, frequency: ArrayLike) -> Float[Array, ""]:
    """The shock that leaves a carried load of a natural frequency at rest.

    An undamped load, a hanging one for instance, swings on by what the acceleration of
    its support has in it of its own frequency. With a jump of the velocity at both ends
    that can be made zero.

    **Arguments:** `travel`: its `duration` and `profile` count; `frequency`: angular,
    positive [rad/s].

    **Returns:** the `shock` of a `Travel` that is otherwise the same.

    **Raises:** ValueError for malformed arguments, and for more than 250 rad of the
    load's own motion in a travel; NaN if that is traced.

    >>> import fdof_jax as fj
    >>> travel = fj.Travel(1.5, profile="harmonic")
    >>> float(fj.shock_against(travel, frequency=8.0))
    2.934
    """
    if not isinstance(travel, Travel):
        raise ValueError(f"travel: expected a Travel, got {travel!r}.")
    frequency = real_array("frequency", frequency, (), above=0)
    turn = frequency * travel.duration
    if (angle := concrete(turn)) is not None and angle > _MOST_TURN:
        raise ValueError(
            f"frequency: expected at most {_MOST_TURN} rad per travel, got {angle:g}."
        )
    # The content of a velocity: its integral times cos(turn (x - 1/2)).
    nodes, weights = np.polynomial.legendre.leggauss(48)
    ends = np.array([0, RAMP, 1 - RAMP, 1])
    half = np.diff(ends)[:, None] / 2
    x = (ends[:-1, None] + half + half * nodes).ravel()
    weight = (half * weights).ravel()
    velocity = jax.vmap(jax.grad(PROFILES[travel.profile]))(jnp.asarray(x))
    of_profile = jnp.sum(weight * velocity * jnp.cos(turn * (x - 0.5)))
    of_constant = jnp.sinc(turn / (2 * jnp.pi))
    shock = of_profile / (of_profile - of_constant)
    return jnp.where(turn <= _MOST_TURN, shock, jnp.nan)
