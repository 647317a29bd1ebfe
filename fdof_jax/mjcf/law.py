"""The law of `Actuators`: affine, with limits and states."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..forces import (
    Condition,
    Part,
    StatefulElement,
    Values,
    clip,
    field,
    of_kind,
    switch,
)


def _limit(shape: tuple, unit: str) -> Any:
    return field(shape, unit=unit, finite=False, default=None)


def _alike(name: str, values: tuple) -> Condition:
    sizes = tuple(len(value) for value in values if value is not None)
    return Condition(len({*sizes}) == 1, name, "as many actuators in all fields", sizes)


class Activation(Part):
    """States s of `Actuators`, one each: a lag, an integrator, a current.

    A state adds gain * s to the force. Its rate is ds/dt = rate . (control, s, length,
    speed), or 0 where s would leave [lower, upper].

    **Arguments:** per actuator, in the units of control and state.

    - `gain`: (actuator,) [N or N m per unit of s]; `start`: s at the start (actuator,).
    - `rate`: (actuator, 4).
    - `lower`, `upper`: (actuator,); by default infinite.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> lag = fj.control.Activation(gain=[10], rate=[[20, -20, 0, 0]], start=[0])
    >>> lagging = dict(gain=[[0, 0, 0]], bias=[[0, 0, 0]], activation=lag)
    >>> motor = fj.control.Actuators([[1, 0]], control=[0.5], **lagging)
    >>> arm = fj.scenes.two_link_circle().linkage
    >>> motor(0.0, [0, 0], [0, 0], arm, motor.initial_state(arm))[1].tolist()
    [10.0]
    """

    gain: Values = field((None,), unit="N or N m per unit of the state")
    rate: Values = field((None, 4), unit="1/s and others")
    start: Values = field((None,), unit="that of the state")
    lower: Values | None = _limit((None,), "that of the state")
    upper: Values | None = _limit((None,), "that of the state")

    def conditions(self):
        values = self.gain, self.rate, self.start, self.lower, self.upper
        yield _alike("gain", values)
        yield from self.ordered("lower", "upper")


class Actuators(StatefulElement):
    """Motors and servos that act on joints through gears, with their own limits.

    An actuator's length is gear . q, its speed gear . qd, and its force

        (gain . (1, length, speed)) control + bias . (1, length, speed)

    clipped to [lower, upper]. The joints feel gear^T force, clipped to [effort_lower,
    effort_upper]. Prefer a `PDController` where it will do: `tune` can change it.

    **Arguments:** per actuator, in the units of its control.

    - `gear`: (actuator, joint), ratios of length to joint positions.
    - `gain`, `bias`: (actuator, 3).
    - `control`: (actuator,), or a function of time that returns it.
    - `lower`, `upper`: (actuator,) [N or N m]; by default infinite.
    - `effort_lower`, `effort_upper`: per joint [N or N m]; by default infinite.
    - `activation`: an `Activation`; by default there are no states.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.two_link_circle().linkage
    >>> law = dict(gain=[[8, 0, 0]], bias=[[0, -8, -2]])  # kp = 8, kv = 2
    >>> servo = fj.control.Actuators([[0, 1]], **law, control=[0.5], upper=[3])
    >>> efforts, _ = servo(0.0, [0.0, 0.0], [0.0, 0.1], arm, ())
    >>> efforts.tolist()
    [0.0, 3.0]
    """

    gear: Values = field((None, "joint"), unit="1, m or 1/m")
    gain: Values = field((None, 3), unit="N or N m per unit of the control")
    bias: Values = field((None, 3), unit="N or N m")
    control: Any = field((None,), unit="that of the actuator", function=True)
    lower: Values | None = _limit((None,), "N or N m")
    upper: Values | None = _limit((None,), "N or N m")
    effort_lower: Values | None = _limit(("joint",), "N or N m")
    effort_upper: Values | None = _limit(("joint",), "N or N m")
    activation: Activation | None = of_kind(Activation, default=None)

    def conditions(self):
        fixed = () if callable(self.control) else (self.control,)
        states = () if self.activation is None else (self.activation.gain,)
        values = self.gear, self.gain, self.bias, self.lower, self.upper
        yield _alike("gear", (*values, *fixed, *states))
        yield from self.ordered("lower", "upper")
        yield from self.ordered("effort_lower", "effort_upper")

    def initial_state(self, linkage):
        """The activations' states at the start, (actuator,); () without."""
        return () if self.activation is None else self.activation.start

    def __call__(self, t, q, qd, linkage, state):
        length, speed = (self.gear @ jnp.asarray(values) for values in (q, qd))
        control = self.value_of("control", t)
        affine = lambda rows: rows[:, 0] + rows[:, 1] * length + rows[:, 2] * speed
        force, rate = affine(self.gain) * control + affine(self.bias), ()
        if (own := self.activation) is not None:
            force = force + own.gain * state
            signals = jnp.stack([control, state, length, speed], axis=1)
            rate = jnp.sum(own.rate * signals, axis=1)
            if own.upper is not None:
                rate = switch(state - own.upper, jnp.minimum(rate, 0), rate)
            if own.lower is not None:
                rate = switch(own.lower - state, jnp.maximum(rate, 0), rate)
        efforts = self.gear.T @ _within(force, self.lower, self.upper)
        return _within(efforts, self.effort_lower, self.effort_upper), rate


def _within(values: Array, lower: Array | None, upper: Array | None) -> Array:
    """Clips to the limits that there are."""
    if lower is None and upper is None:
        return values
    low = -np.inf if lower is None else lower
    high = np.inf if upper is None else upper
    return clip(values, low, high)
