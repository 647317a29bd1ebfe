"""One of each force element of the library, at work on a small arm."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from helpers import Hold as Hold

import fdof_jax as fj

ARM = dict(
    length=[0.1, 1.0, 0.8, 0.6], com=[[0.5, 0.1], [0.4, 0.0], [0.3, 0.05]],
    mass=[2.0, 1.5, 1.0], inertia=[0.3, 0.2, 0.1],
)  # fmt: skip
# From NumPy, which compiles nothing.
START = fj.State(
    *jax.device_put((np.array([0.3, -0.2, 0.5]), np.array([0.5, -0.7, 0.9])))
)


def arm(topology):
    return fj.Linkage(topology, locked=[0.3, -0.2, 0.4], base_angle=0.2, **ARM)


HOOK, ELBOW, TIP = fj.Point(0, 0.3, -0.4), fj.Point(2, 0.5, 0.2), fj.Point(3, 0.4)


class Swing(eqx.Module):
    """A reference without jumps, which every step size controller accepts."""

    amplitude: jax.Array

    def __call__(self, t, linkage):
        phase = jnp.arange(float(self.amplitude.size))
        rate = 3 * jnp.cos(3 * t + phase)
        return self.amplitude * jnp.sin(3 * t + phase), self.amplitude * rate


MOVE = Swing(jax.device_put(np.array([0.3, 0.5, 0.2])))
PD = fj.PDController([9.0, 7.0, 5.0], [3.0, 2.0, 1.0], [4.0, 2.0, 9.0], MOVE)

# For laws of any solver: compiles faster than the default; differences are exact.
SHORT = dict(
    solver=diffrax.Midpoint(), stepsize_controller=diffrax.ConstantStepSize(), dt0=0.01
)
FORWARD = dict(adjoint=diffrax.ForwardMode())

# A bar and a slide of 1 kg, whose programs compile faster than those of three links
BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
SLIDE = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], gravity=0.0)

# Efforts in the joints, between points and from outside
PLAIN = {
    "damper": fj.JointDamper([0.3, 0.2, 0.1]),
    "joint spring": fj.forces.JointSpring([0.9, 0.6, 0.4], rest=[0.4, 0.0, -0.3]),
    "effort": fj.JointEffort([1.0, -0.5, 0.3]),
    "PD": PD,
    "history": fj.forces.EffortHistory(
        [0.013, 0.0519, 0.0873, 0.3], [[2, 0, 1], [-1, 3, 0], [0, 1, 2], [1, 1, -3]]
    ),
    "gravity": fj.control.GravityFeedforward(
        [9.0, 7.0, 5.0], [3.0, 2.0, 1.0], [4.0, 50.0, 9.0], MOVE
    ),
    "computed torque": fj.control.ComputedTorque(
        [9.0, 7.0, 5.0], [3.0, 2.0, 1.0], [90.0, 2.0, 60.0], MOVE, arm("RPR")
    ),
    "spring": fj.SpringDamper(
        HOOK, ELBOW, stiffness=30.0, damping=2.0, rest_length=0.4
    ),
    "cable": fj.SpringDamper(
        HOOK, ELBOW, stiffness=20.0, damping=0.1, rest_length=0.3, one_sided="cable"
    ),
    "bumper": fj.SpringDamper(
        HOOK, TIP, stiffness=25.0, damping=0.1, rest_length=3.0, one_sided="bumper"
    ),
    "tension": fj.forces.Tension(HOOK, TIP, 2.5),
    "wrench": fj.Wrench(TIP, [3.0, -2.0], 0.7),
    "following wrench": fj.Wrench(ELBOW, [1.0, 2.0], follows=True),
    "stops": fj.forces.JointStops(
        [-1.0, -0.12, -np.inf], [0.22, 2.0, 0.35], stiffness=40.0, damping=0.5,
        smoothing=0.1,
    ),
    "friction": fj.forces.JointFriction([0.4, 0.3, 0.2], speed=0.5),
}  # fmt: skip
WITH_STATE = {
    "speed limit": fj.control.SpeedLimit(PD, stall=[1.0, 3.0, 0.5], no_load=4.0),
    "PID": fj.control.PIDController(8.0, [4.0, 3.0, 2.0], 2.0, [3.0, 9.0, 1.0], MOVE),
    "lag": fj.control.FirstOrderLag(PD, 0.2, start=[0.5, 0.0, 0.0]),
    "motor": fj.control.DCMotor(
        PD, resistance=2.0, inductance=0.3, constant=0.4, gear=3.0,
        voltage_limit=[5.0, 0.2, 5.0],
        current_limit=[0.3, 9.0, 0.1],
    ),
}  # fmt: skip
WITH_STATE["actuators"] = fj.control.Actuators(
    gear=[[2.0, 0.0, 0.0], [0.0, 1.0, -0.5]],
    gain=[[0.0, 0.0, 0.0], [4.0, 0.5, -0.3]],
    bias=[[0.1, -3.0, -0.4], [0.2, -2.0, -0.6]],
    control=[0.4, 0.7],
    upper=[0.6, 9.0],
    effort_lower=[-9.0, -0.5, -9.0],
    activation=fj.control.Activation(
        gain=[3.0, -2.0], rate=[[4.0, -4.0, 0.1, -0.2], [1.0, -0.5, 0.3, 0.2]],
        start=[0.1, 0.2],
    ),
)  # fmt: skip
WITH_STATE["static motor"] = WITH_STATE["motor"].replace(inductance=0)
WITH_STATE["motor with PID"] = fj.control.FirstOrderLag(WITH_STATE["PID"], 0.1)
WITH_INERTIA = {
    "armature": fj.forces.Armature([0.3, 0.2, 0.1]),
    "rotor": fj.forces.Rotor([0.05, 0.03, 0.02], gear=[2.0, -3.0, 1.5]),
    "actuator": fj.LinearActuator(
        HOOK, ELBOW, force=5.0, mass=[1.2, 0.7], com=[0.2, 0.3], inertia=[0.05, 0.03]
    ),
}
WITH_INERTIA["payload"] = fj.forces.Payload(TIP, 0.4, 0.05)
# Those that hold joints for a while, or take a mass: not for fixed steps
HOLDING = {
    "sticking friction": fj.forces.JointFriction(
        [0.4, 0.3, 0.2], static=[0.5, 0.3, 0.4]
    ),
    "hard stops": fj.forces.HardStops(
        [-1.0, -0.5, -np.inf], 0.9, restitution=[0.3, 0.1, 0]
    ),
    "brake": fj.forces.Brake([2, 3], begin=0.03, end=0.06),
    "taken": fj.forces.Payload(TIP, 0.4, 0.05, begin=0.02, end=0.07),
}  # fmt: skip
ALL = PLAIN | WITH_STATE | WITH_INERTIA
