from .drives import (
    DCMotor as DCMotor,
    FirstOrderLag as FirstOrderLag,
    PIDController as PIDController,
    SpeedLimit as SpeedLimit,
)
from .gains import gains_from_frequency as gains_from_frequency
from .model_based import (
    ComputedTorque as ComputedTorque,
    GravityFeedforward as GravityFeedforward,
)
from .pd import PDController as PDController

__all__: list[str]
