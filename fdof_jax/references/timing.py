"""Timing along a path: profiles of point-to-point motions, and laps."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import concrete, instance, one_of, real_array
from ..linkage.fields import Condition, Part, Values, field

_MOST_TURN = 250  # [rad], as far as 48 nodes per piece resolve
_PASSES = 3
RAMP = 0.25  # share of its time in which a trapezoidal profile speeds up


def _trapezoidal(x: Array) -> Array:
    scale = 2 * RAMP * (1 - RAMP)
    cruising, slowing = (x - RAMP / 2) / (1 - RAMP), 1 - (1 - x) ** 2 / scale
    later = jnp.where(x > 1 - RAMP, slowing, cruising)
    return jnp.where(x < RAMP, x**2 / scale, later)


# The share of the way as a function of the share of the time, both from 0 to 1.
PROFILES: dict[str, Callable[[Array], Array]] = {
    "harmonic": lambda x: (1 - jnp.cos(np.pi * x)) / 2,
    "cycloidal": lambda x: x - jnp.sin(2 * np.pi * x) / (2 * np.pi),
    "quintic": lambda x: x**3 * (10 - 15 * x + 6 * x**2),
    "trapezoidal": _trapezoidal,
}


class Travel(Part):
    """The timing of a travel from the start of a path to its end in a given time.

    **Arguments:**

    - `duration`: positive [s].
    - `begin`: time at which the travel starts [s]; it rests before.
    - `profile`: "harmonic" (the way is a cosine), "cycloidal" (the acceleration is a
      sine), "quintic" (no acceleration at both ends; the default) or "trapezoidal" (the
      velocity is a trapezium, speeding up and slowing down in a quarter of the time
      each).
    - `shock`: share of the way done at constant velocity. The velocity then jumps at
      both ends; see `shock_against`.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> harmonic = fj.references.Travel(2.0, profile="harmonic")
    >>> [float(harmonic(t)) for t in (0, 0.5, 1, 3)]
    [0.0, 0.146, 0.5, 1.0]
    """

    duration: Values = field((), unit="s", above=0)
    begin: Values = field((), unit="s", default=0.0, kw_only=True)
    profile: str = eqx.field(static=True, default="quintic", kw_only=True)
    shock: Values = field((), unit="", default=0.0, kw_only=True)

    def __check_init__(self):
        one_of("profile", self.profile, tuple(PROFILES))

    def __call__(self, t: Array) -> Array:
        """The share of the way at time `t` [s], from 0 to 1."""
        x = (t - self.begin) / self.duration
        # At a jump the derivative is that after it; jnp.clip's would be the mean.
        x = jnp.where(x < 0, 0, jnp.where(x < 1, x, 1))
        return (1 - self.shock) * PROFILES[self.profile](x) + self.shock * x

    @property
    def jump_ts(self) -> Array:
        """Times at which velocity or acceleration jump [s]."""
        shares = [0.0, 1.0]
        if self.profile == "trapezoidal":
            shares = [0.0, RAMP, 1 - RAMP, 1.0]
        return self.begin + self.duration * np.array(shares, self.duration.dtype)


class Laps(Part):
    """The timing of endless laps of a closed path, at constant rate of its parameter.

    **Arguments:** `period`: time of one lap, backwards if negative, not zero [s];
    `phase`: starting point as a share of a lap.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> [float(fj.references.Laps(period=4)(t)) for t in (1, 4, 10)]
    [0.25, 1.0, 2.5]
    """

    period: Values = field((), unit="s")
    phase: Values = field((), unit="", default=0.0, kw_only=True)

    def conditions(self):
        yield Condition(self.period != 0, "period", "not zero", (self.period,))

    def __call__(self, t: Array) -> Array:
        return self.phase + t / self.period


def times_of_moves(timing: Callable[[Array], Array], times: Array) -> Array:
    """Adds as many times, at which the share of the way changes between the given ones.

    A short move in a long run may lie between two times. Each pass finds it a thousand
    times as closely.
    """
    found = times
    for _ in range(_PASSES):
        moves = jnp.abs(jnp.diff(jax.vmap(timing)(found)))
        way = jnp.append(0, jnp.cumsum(jnp.where(jnp.isfinite(moves), moves, 0)))
        found = jnp.interp(jnp.linspace(0, way[-1], len(times)), way, found)
    return jnp.sort(jnp.concatenate([times, found]))


def shock_against(travel: Travel, frequency: ArrayLike) -> Float[Array, ""]:
    """Computes the shock that leaves a carried load of a natural frequency at rest.

    After the travel, an undamped load (for instance a hanging one) swings as much as
    its support's acceleration contains its natural frequency. Jumps of the velocity at
    both ends can make this content zero.

    **Arguments:** `travel`: its `duration` and `profile` are used; `frequency`: natural
    angular frequency of the load, positive [rad/s].

    **Returns:** the `shock` of a `Travel` that is otherwise the same.

    **Raises:** ValueError for malformed arguments, and if `frequency * duration`
    exceeds 250 rad (the result is NaN if that product is traced).

    >>> import fdof_jax as fj
    >>> travel = fj.references.Travel(1.5, profile="harmonic")
    >>> float(fj.references.shock_against(travel, frequency=8.0))
    2.934
    """
    instance("travel", travel, Travel)
    frequency = real_array("frequency", frequency, (), above=0)
    turn = frequency * travel.duration
    if (angle := concrete(turn)) is not None and angle > _MOST_TURN:
        raise ValueError(
            f"frequency: expected at most {_MOST_TURN} rad per travel, got {angle:g}."
        )
    # A velocity's content of the frequency is the integral of v(x) cos(turn (x - 1/2)).
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
