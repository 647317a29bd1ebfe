"""Timing along a path: profiles of point-to-point motions, and laps."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.checks import one_of
from ..linkage.fields import Condition, Part, Values, field

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
    """The timing of a travel along a path in a given time.

    **Arguments:**

    - `duration`: positive [s].
    - `begin`: when the travel starts [s]; the reference rests before.
    - `profile`: "harmonic" (the way is a cosine), "cycloidal" (the acceleration is a
      sine), "quintic" (no acceleration at both ends; the default) or "trapezoidal" (the
      velocity rises and falls in a quarter of the time each).
    - `shock`: share of the way done at constant velocity, which then jumps at both
      ends.

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
        """Returns the share of the way at time `t` [s], from 0 to 1."""
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
    """Adds as many times, at which the share of the way changes between those given."""
    # A short move in a long run may lie between two times. Each pass finds it a
    # thousand times as closely.
    found = times
    for _ in range(_PASSES):
        moves = jnp.abs(jnp.diff(jax.vmap(timing)(found)))
        way = jnp.append(0, jnp.cumsum(jnp.where(jnp.isfinite(moves), moves, 0)))
        found = jnp.interp(jnp.linspace(0, way[-1], len(times)), way, found)
    return jnp.sort(jnp.concatenate([times, found]))
