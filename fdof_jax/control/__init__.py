"""Controllers, feedforward and drives."""

from ..mjcf.law import Activation, Actuators
from .pd import ComputedTorque, GravityFeedforward, PDController, gains_from_frequency

# isort: split
# Last, as `drives` imports names from above.
from ..servo.drives import (
    DCMotor,
    Drive,
    FirstOrderLag,
    PIDController,
    SpeedLimit,
    controller_in,
)

__all__ = [
    "Activation", "Actuators", "ComputedTorque", "controller_in", "DCMotor", "Drive",
    "FirstOrderLag", "gains_from_frequency", "GravityFeedforward", "PDController",
    "PIDController", "SpeedLimit",
]  # fmt: skip
__dir__ = __all__.copy
