"""Servo drives: what stands between a controller's command and a joint's effort.

All work joint by joint. A command is a force element `(t, q, qd, linkage) -> (3,)`
without a state of its own, a `PDController` for instance; what it returns is an effort,
or for a motor a voltage.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .control import PDController, Reference
from .forces import StatefulElement
from .linkage import Linkage
from .validation import real_array


def _command(value: Any) -> Any:
    plain = callable(value) and not isinstance(value, type | StatefulElement)
    if not plain:
        raise ValueError(
            "command: expected a force element without a state, a PDController for "
            f"instance, got {value!r}."
        )
    return value


class _Commanded(eqx.Module):
    """What has a command passes its jumps and its checks on."""

    command: eqx.AbstractVar[Any]

    @property
    def jump_ts(self) -> Array | None:
        """The times at which the command says that it jumps, if it does."""
        return getattr(self.command, "jump_ts", None)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """The command's own check, if it has one."""
        check: Any = getattr(self.command, "check", None)
        if check is not None:
            check(linkage, ts)


class PIDController(StatefulElement):
    """PD control with an integral of the position error, and limits.

    The effort is that of a `PDController` plus ki times the integral, clipped to
    +-limit as a whole. Anti-windup by back-calculation: what the limit takes away
    drains the integral, at the rate 1 / `unwind`.

    **Arguments:** one per joint or one for all.

    - `kp`, `kd`, `limit`, `reference`: as in `PDController`.
    - `ki`: gains of the integral, not negative [N/(m s) or N m/(rad s)].
    - `unwind`: time in which an integral that the limit cuts off drains, positive [s].

    **Raises:** ValueError for malformed arguments.
    """

    pd: PDController
    ki: Float[Array, " joint"]
    unwind: Float[Array, " joint"]

    def __init__(
        self,
        kp: ArrayLike,
        ki: ArrayLike,
        kd: ArrayLike,
        limit: ArrayLike,
        reference: Reference,
        *,
        unwind: ArrayLike = 0.1,
    ):
        self.pd = PDController(kp, kd, limit, reference)
        self.ki = real_array("ki", ki, (3,), minimum=0, broadcast=True)
        self.unwind = real_array("unwind", unwind, (3,), above=0, broadcast=True)

    def initial_state(self, linkage):
        """The integral's share of the effort, (3,) [N or N m]."""
        return jnp.zeros(3)

    def __call__(self, t, q, qd, linkage, state):
        demand = self.pd.demand(t, q, qd, linkage) + state
        effort = jnp.clip(demand, -self.pd.limit, self.pd.limit)
        position, _ = self.pd.reference(t, linkage)
        rate = self.ki * (position - q) + (effort - demand) / self.unwind
        return effort, rate

    @property
    def jump_ts(self) -> Array | None:
        """The times at which the reference says that it jumps, if it does."""
        return self.pd.jump_ts

    def check(self, linkage: Linkage, ts: Array) -> None:
        """The reference's own check, if it has one."""
        self.pd.check(linkage, ts)


class FirstOrderLag(_Commanded, StatefulElement):
    """An effort that follows its command with a lag: its rate is the gap over a time.

    **Arguments:** `command`: a force element; `time_constant`: one per joint or one for
    all, positive [s]; `initial`: the effort at the start [N or N m].

    **Raises:** ValueError for malformed arguments.
    """

    command: Any
    time_constant: Float[Array, " joint"]
    initial: Float[Array, " joint"]

    def __init__(
        self, command: Any, time_constant: ArrayLike, *, initial: ArrayLike = 0.0
    ):
        self.command = _command(command)
        self.time_constant = real_array(
            "time_constant", time_constant, (3,), above=0, broadcast=True
        )
        self.initial = real_array("initial", initial, (3,), broadcast=True)

    def initial_state(self, linkage):
        """The effort, (3,) [N or N m]."""
        return self.initial

    def __call__(self, t, q, qd, linkage, state):
        gap = self.command(t, q, qd, linkage) - state
        return state, gap / self.time_constant


class SpeedLimit(_Commanded):
    """An effort whose limit falls with speed: a straight torque-speed curve.

    In the direction of motion at most stall * (1 - |qd| / no_load), and not below 0;
    against it, at most stall.

    **Arguments:** `command`: a force element; one per joint or one for all, positive:
    `stall` [N or N m], `no_load` [m/s or rad/s].

    **Raises:** ValueError for malformed arguments.
    """

    command: Any
    stall: Float[Array, " joint"]
    no_load: Float[Array, " joint"]

    def __init__(self, command: Any, stall: ArrayLike, no_load: ArrayLike):
        self.command = _command(command)
        self.stall = real_array("stall", stall, (3,), above=0, broadcast=True)
        self.no_load = real_array("no_load", no_load, (3,), above=0, broadcast=True)

    def __call__(self, t, q, qd, linkage):
        left = jnp.clip(1 - qd / self.no_load, 0, 1)  # of the positive limit
        right = jnp.clip(1 + qd / self.no_load, 0, 1)
        wanted = self.command(t, q, qd, linkage)
        return jnp.clip(wanted, -self.stall * right, self.stall * left)


class DCMotor(_Commanded, StatefulElement):
    """Brushed motors on geared joints: winding, back-EMF, limited voltage and current.

    inductance * di/dt = v - resistance * i - constant * gear * qd, and the effort is
    constant * gear * i. The command gives the voltages v, clipped to +-voltage_limit;
    where a current is at its limit, the drive lets it grow no further. Rotors are an
    `Armature` beside it.

    **Arguments:** one per joint or one for all, positive.

    - `command`: a force element, read as voltages [V].
    - `resistance` [ohm], `inductance` [H]: of the winding.
    - `constant`: of torque and back-EMF [N m/A = V s/rad; N/A for a slide].
    - `gear`: turns of the motor per turn of the joint (per metre of a slide).
    - `voltage_limit` [V], `current_limit` [A]: may be infinite.

    **Raises:** ValueError for malformed arguments.
    """

    command: Any
    resistance: Float[Array, " joint"]
    inductance: Float[Array, " joint"]
    constant: Float[Array, " joint"]
    gear: Float[Array, " joint"]
    voltage_limit: Float[Array, " joint"]
    current_limit: Float[Array, " joint"]

    def __init__(
        self,
        command: Any,
        *,
        resistance: ArrayLike,
        inductance: ArrayLike,
        constant: ArrayLike,
        gear: ArrayLike = 1.0,
        voltage_limit: ArrayLike = jnp.inf,
        current_limit: ArrayLike = jnp.inf,
    ):
        def positive(name: str, value: ArrayLike, finite: bool = True) -> Array:
            return real_array(name, value, (3,), above=0, finite=finite, broadcast=True)

        self.command = _command(command)
        self.resistance = positive("resistance", resistance)
        self.inductance = positive("inductance", inductance)
        self.constant = positive("constant", constant)
        self.gear = positive("gear", gear)
        self.voltage_limit = positive("voltage_limit", voltage_limit, finite=False)
        self.current_limit = positive("current_limit", current_limit, finite=False)

    def initial_state(self, linkage):
        """The currents, (3,) [A]."""
        return jnp.zeros(3)

    def __call__(self, t, q, qd, linkage, state):
        wanted = self.command(t, q, qd, linkage)
        voltage = jnp.clip(wanted, -self.voltage_limit, self.voltage_limit)
        per_joint = self.constant * self.gear
        rate = (voltage - self.resistance * state - per_joint * qd) / self.inductance
        outwards = (jnp.abs(state) >= self.current_limit) & (rate * state > 0)
        return per_joint * state, jnp.where(outwards, 0, rate)
