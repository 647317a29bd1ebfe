"""Analysis of configurations and motions."""

from ..dynamics import inertia_ratios
from .reactions import inertial_parameters, joint_reactions, regressor

# isort: split
# Last, as `servo` imports names from above.
from ..servo.linearization import (
    Linearization,
    Modes,
    closed_loop_modes,
    equilibrium,
    holding_efforts,
    linearize,
    loop_matrices,
)
from ..servo.loops import Margins, bandwidth, closed_loop, margins, open_loop
from ..servo.measures import Response, response, step_measures

__all__ = [
    "bandwidth", "closed_loop", "closed_loop_modes", "equilibrium", "holding_efforts",
    "inertia_ratios", "inertial_parameters", "joint_reactions", "Linearization",
    "linearize", "loop_matrices", "Margins", "margins", "Modes", "open_loop",
    "regressor", "Response", "response", "step_measures",
]  # fmt: skip
__dir__ = __all__.copy
