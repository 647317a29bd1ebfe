"""PID control, and servo drives, which turn a command into a joint's effort."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from ..checks import is_traced, real_array
from ..control import PDController
from ..forces import (
    Condition,
    StatefulElement,
    Values,
    called,
    clip,
    element_of,
    field,
    naming,
)
from ..linkage import Linkage, joints_of


class PIDController(StatefulElement):
    """Saturated PID control of the joints, with anti-windup: a force element.

    The effort is that of a `PDController` plus ki times the integral of the position
    error, clipped to +-limit as a whole. The clipped part drains the integral with the
    time constant kp / ki (back-calculation).

    **Arguments:** one value per joint or one for all.

    - `kp`, `kd`, `limit`, `reference`: as in `PDController`, which is the field `pd`.
    - `ki`: integral gains, not negative; 0 where kp is [N/(m s) or N m/(rad s)].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> task = fj.CircleTask()
    >>> pid = fj.control.PIDController(kp=100, ki=50, kd=0, limit=30, reference=task)
    >>> q, qd = task(0.0, arm)
    >>> effort, rate = pid(0.0, q - 0.1, qd, arm, pid.initial_state(arm))
    >>> effort.tolist(), rate.tolist()  # the integral's share grows
    ([10.0, 10.0, 10.0], [5.0, 5.0, 5.0])
    """

    pd: PDController
    ki: Values = field(unit="N/(m s) or N m/(rad s)", minimum=0)

    def __init__(
        self,
        kp: ArrayLike,
        ki: ArrayLike,
        kd: ArrayLike,
        limit: ArrayLike,
        reference: Callable,
    ):
        self.pd = PDController(kp, kd, limit, reference)
        self.ki = ki

    def arguments(self) -> dict[str, Any]:
        return self.pd.arguments() | {"ki": self.ki}

    def conditions(self):
        paired = ((self.ki <= 0) | (self.pd.kp > 0)).all()
        yield Condition(paired, "ki", "0 where kp is 0", (self.ki, self.pd.kp))

    def initial_state(self, linkage):
        """Returns the integral's share at the start: zeros (n,) [N or N m]."""
        return jnp.zeros(joints_of(linkage))

    def __call__(self, t, q, qd, linkage, state):
        position, velocity = self.pd.schedule(t, linkage)
        proportional = self.pd.kp * (position - q)
        demand = proportional + self.pd.kd * (velocity - qd) + state
        effort = clip(demand, -self.pd.limit, self.pd.limit)
        per_time = self.ki / jnp.where(self.pd.kp > 0, self.pd.kp, 1)
        return effort, per_time * (proportional + effort - demand)


class DriveState(NamedTuple):
    """State of a drive: its `own` and its `command`'s state, () without one."""

    own: PyTree
    command: PyTree


class Drive(StatefulElement):
    """A base for drives, which stand between a command and the effort that acts.

    A subclass implements `respond`, and `initial` if it has a state.

    - `command`: a force element whose effort is the command [N or N m].

    >>> import fdof_jax as fj
    >>> class Halved(fj.control.Drive):
    ...     def respond(self, command, qd, own):
    ...         return command / 2, own
    >>> drive, (arm, start, *_) = Halved(fj.JointEffort([4.0, 2, 0])), fj.scenes.fig5()
    >>> efforts, rates = drive(0.0, *start, arm, drive.initial_state(arm))
    >>> efforts.tolist()
    [2.0, 1.0, 0.0]
    """

    command: Callable = called("a force element, a PDController for instance")

    def initial(self, linkage: Linkage) -> PyTree:
        """Returns the drive's own state at the start."""
        return ()

    @abstractmethod
    def respond(self, command: Array, qd: Array, own: PyTree) -> tuple[Array, PyTree]:
        """Returns the efforts (n,) and the rate of the drive's own state."""

    def initial_state(self, linkage):
        inner = element_of(self.command).initial_state(linkage)
        return DriveState(self.initial(linkage), inner)

    def check(self, linkage, ts):
        with naming("command"):
            element_of(self.command).check(linkage, ts)

    def __call__(self, t, q, qd, linkage, state):
        own, inner = state
        with naming("command"):
            command, inner_rate = element_of(self.command).act(t, q, qd, linkage, inner)
        effort, rate = self.respond(real_array("command", command, (len(qd),)), qd, own)
        return effort, DriveState(rate, inner_rate)


def controller_in(element: object) -> PDController | None:
    """Returns the controller that an element is, or holds as its command, or None.

    For a `PIDController`, this is its PD part, with the limits [N or N m].
    """
    while isinstance(element, Drive):
        element = element.command
    if isinstance(element, PIDController):
        return element.pd
    return element if isinstance(element, PDController) else None


class FirstOrderLag(Drive):
    """A drive whose effort follows its command with a first-order lag.

    The rate of the effort is (command - effort) / time_constant.

    **Arguments:** `command`: a force element; `time_constant`: one per joint or one for
    all, positive [s]; `start`: initial effort, by default 0 [N or N m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> lag = fj.control.FirstOrderLag(fj.JointEffort([10, 0, 0]), time_constant=0.1)
    >>> effort, rate = lag(0.0, [0, 0, 0], [0, 0, 0], arm, lag.initial_state(arm))
    >>> effort.tolist(), rate.own.tolist()  # towards 10 N m, in 0.1 s at this rate
    ([0.0, 0.0, 0.0], [100.0, 0.0, 0.0])
    """

    time_constant: Values = field(unit="s", above=0)
    start: Values = field(unit="N or N m", default=0.0, kw_only=True)

    def initial(self, linkage):
        return jnp.broadcast_to(self.start, joints_of(linkage))

    def respond(self, command, qd, own):
        return own, (command - own) / self.time_constant


class SpeedLimit(Drive):
    """A drive whose effort limit falls with speed: a straight torque-speed curve.

    In the direction of motion the effort is at most stall * (1 - |qd| / no_load), not
    below 0. Against the motion it is at most stall.

    Servo amplifiers with a current limit have this curve. Where only the voltage is
    limited, use a `DCMotor`.

    **Arguments:** `command`: a force element; `stall` [N or N m] and `no_load`
    [m/s or rad/s]: one per joint or one for all, positive.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> import jax.numpy as jnp
    >>> limited = fj.control.SpeedLimit(fj.JointEffort([9, 9, 9]), stall=8, no_load=4)
    >>> speeds, state = jnp.array([0.0, 2.0, 5.0]), limited.initial_state(arm)
    >>> limited(0.0, [0, 0, 0], speeds, arm, state)[0].tolist()
    [8.0, 4.0, 0.0]
    """

    stall: Values = field(unit="N or N m", above=0)
    no_load: Values = field(unit="m/s or rad/s", above=0)

    def respond(self, command, qd, own):
        left = clip(1 - qd / self.no_load, 0, 1)  # share of the positive limit
        right = clip(1 + qd / self.no_load, 0, 1)
        return clip(command, -self.stall * right, self.stall * left), ()


class DCMotor(Drive):
    """Brushed motors on geared joints: winding, back-EMF, limited voltage and current.

    The current i obeys inductance * di/dt = v - resistance * i - constant * gear * qd,
    and the effort is constant * gear * i. The command's voltages v are clipped such
    that the current stays within its limit, then to +-voltage_limit. Back-EMF beyond
    the voltage limit drives the current. The rotor's inertia is a separate `Rotor` or
    `Armature`.

    Without inductance the current is (v - constant * gear * qd) / resistance at once,
    and the motor has no state. Leave the inductance out where inductance / resistance,
    often a millisecond, is short beside the motion: explicit steps would be as short.

    **Arguments:** one value per joint or one for all, positive.

    - `command`: a force element whose efforts are the voltages [V].
    - `resistance`, `inductance`: those of the winding [ohm, H]. The inductance is 0 in
      all joints (the default, stored as None) or in none; a traced one is positive.
    - `constant`: torque and back-EMF constant [N m/A = V s/rad; N/A of a linear motor].
    - `gear`: angle of the motor per angle of the joint [1] or per metre of a slide
      [rad/m].
    - `voltage_limit` [V], `current_limit` [A]: may be infinite.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> import jax.numpy as jnp
    >>> volts = fj.JointEffort([24, 24, 24])
    >>> motor = fj.control.DCMotor(volts, resistance=2, inductance=0.01, constant=0.1)
    >>> speeds, state = jnp.array([0.0, 120, 240]), motor.initial_state(arm)
    >>> motor(0.0, [0, 0, 0], speeds, arm, state)[1].own.tolist()  # rates [A/s]
    [2400.0, 1200.0, 0.0]
    >>> static = motor.replace(inductance=0)
    >>> static(0.0, [0, 0, 0], speeds, arm, static.initial_state(arm))[0].tolist()
    [1.2, 0.6, 0.0]
    """

    resistance: Values = field(unit="ohm", above=0, kw_only=True)
    inductance: Values | None = field(
        unit="H", minimum=0, optional=True, default=0.0, kw_only=True
    )
    constant: Values = field(unit="N m/A or N/A", above=0, kw_only=True)
    gear: Values = field(unit="1 or rad/m", above=0, default=1.0, kw_only=True)
    voltage_limit: Values = field(
        unit="V", above=0, finite=False, default=jnp.inf, kw_only=True
    )
    current_limit: Values = field(
        unit="A", above=0, finite=False, default=jnp.inf, kw_only=True
    )

    def __check_init__(self):
        # Whether currents are states has to be known where the numbers are traced.
        if self.inductance is not None and not is_traced(self.inductance):
            rules = type(self).__dataclass_fields__["inductance"].metadata["rules"]
            real_array("inductance", self.inductance, **rules)  # refuses
            # An `any` of JAX would be traced within `jax.jit`.
            if not np.asarray(self.inductance).any():
                object.__setattr__(self, "inductance", None)

    def conditions(self):
        if self.inductance is not None:
            expected = "above 0 in all joints, or 0 in all"
            positive = (self.inductance > 0).all()
            yield Condition(positive, "inductance", expected, self.inductance)

    def initial(self, linkage):
        """Returns the currents at the start [A]; none without inductance."""
        return () if self.inductance is None else jnp.zeros(joints_of(linkage))

    def respond(self, command, qd, own):
        per_joint = self.constant * self.gear
        back_emf = per_joint * qd
        # Infinity times a tangent of 0 would be NaN.
        unlimited = jnp.isinf(self.current_limit)
        most = self.resistance * jnp.where(unlimited, 0, self.current_limit)
        most = jnp.where(unlimited, jnp.inf, most)
        voltage = clip(command, back_emf - most, back_emf + most)
        voltage = clip(voltage, -self.voltage_limit, self.voltage_limit)
        if self.inductance is None:
            return per_joint * (voltage - back_emf) / self.resistance, ()
        rate = (voltage - self.resistance * own - back_emf) / self.inductance
        return per_joint * own, rate
