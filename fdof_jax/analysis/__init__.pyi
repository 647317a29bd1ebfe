from ..dynamics import inertia_ratios as inertia_ratios
from .equilibria import equilibrium as equilibrium, holding_efforts as holding_efforts
from .linearization import (
    Linearization as Linearization,
    Modes as Modes,
    closed_loop_modes as closed_loop_modes,
    linearize as linearize,
)
from .loops import (
    Margins as Margins,
    bandwidth as bandwidth,
    closed_loop as closed_loop,
    margins as margins,
    open_loop as open_loop,
)
from .reactions import joint_reactions as joint_reactions
from .regression import (
    inertial_parameters as inertial_parameters,
    regressor as regressor,
)
from .responses import StepAndSine as StepAndSine, step_and_sine as step_and_sine

__all__: list[str]
