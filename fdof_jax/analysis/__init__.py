"""Analysis of configurations and motions: equilibria, linearisation, reactions."""

from ..dynamics import inertia_ratios
from .linearization import (
    Linearization,
    Modes,
    closed_loop_modes,
    equilibrium,
    holding_efforts,
    linearize,
)
from .loops import Margins, bandwidth, closed_loop, margins, open_loop
from .measures import Response, response
from .reactions import inertial_parameters, joint_reactions, regressor

__all__ = [
    "bandwidth", "closed_loop", "closed_loop_modes", "equilibrium", "holding_efforts",
    "inertia_ratios", "inertial_parameters", "joint_reactions", "Linearization",
    "linearize", "Margins", "margins", "Modes", "open_loop", "regressor", "Response",
    "response",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
