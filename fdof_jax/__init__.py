"""Dynamics of planar open-chain linkages in JAX.

    import fdof_jax as fj
    fj.configure(x64=True)                     # double precision, before all else
    scene = fj.scenes.fig7()                   # or your own Linkage, State and elements
    motion = fj.simulate(scene, [0, scene.t1])

Units are SI. `help(fj.simulate)` documents a name; submodules hold more names.

- **Arms**: Linkage, State, Scene, TOPOLOGIES, existence_factors, joint_positions,
  mass_centers, tip_position, tip_jacobian, inverse_kinematics.
- **Forces**, more in `forces`: JointDamper, JointEffort, SpringDamper, Wrench, Point,
  LinearActuator. For your own: Element, field, Values.
- **Controllers**, more in `control`, `references`: PDController, TipTask, CircleTask.
- **Motions**, more in `simulation`: simulate, sweep for many, simulate_sampled and step
  for sampled controllers; Solution.
- **At one instant**: forward_dynamics, inverse_dynamics, mass_matrix, bias_force,
  energy, link_energies. The paper's six equations: paper.
- **Analysis**, more in `analysis`: joint_efforts, joint_reactions, linearize.
- **Gains**, more in `tuning`: tune, TuneResult. **Parameters from recordings**, more
  in `identification`: fit, FitResult.
- **Pictures**: view, drawing, plotting. **Files and tables**, more in `data`: save,
  load, to_pandas, to_xarray, to_mjcf, from_mjcf.
- **The paper's figures**: scenes. **For code of your own**: `fdof_jax.checks` of
  arguments, and questions about an arm in `fdof_jax.linkage`.
"""

import importlib
from typing import TYPE_CHECKING

from . import (
    checks as checks,
    control,
    forces,
    linkage as linkage,
    paper,
    references,
    simulation,
)
from .base.configuration import configure
from .base.version import __version__ as __version__
from .batches.sweep import sweep
from .control.pd import PDController
from .dynamics import (
    bias_force,
    energy,
    forward_dynamics,
    inverse_dynamics,
    link_energies,
    mass_matrix,
)
from .forces.actuators import LinearActuator
from .forces.element import Element
from .forces.joints import JointDamper, JointEffort
from .forces.points import Point, SpringDamper, Wrench
from .linkage.coordinates import State
from .linkage.fields import Values, field
from .linkage.linkage import Linkage
from .linkage.topology import TOPOLOGIES, existence_factors
from .mechanics.inverse_kinematics import inverse_kinematics
from .mechanics.kinematics import (
    joint_positions,
    mass_centers,
    tip_jacobian,
    tip_position,
)
from .references.task import CircleTask, TipTask
from .simulation.efforts import joint_efforts
from .simulation.sampled_control import simulate_sampled, step
from .simulation.scene import Scene
from .simulation.simulate import simulate
from .simulation.solution import Solution

if TYPE_CHECKING:
    from .pictures import drawing, plotting
    from .viewer.view import view

# Last, as leaves import names from above.
from . import analysis, data, identification, scenes, tuning
from .analysis import joint_reactions, linearize
from .data import from_mjcf, load, save, to_mjcf, to_pandas, to_xarray
from .identification import FitResult, fit
from .tuning import TuneResult, tune

__all__ = [
    "analysis", "bias_force", "CircleTask", "configure", "control", "data", "drawing",
    "Element", "energy", "existence_factors", "field", "fit", "FitResult", "forces",
    "forward_dynamics", "from_mjcf", "identification",
    "inverse_dynamics", "inverse_kinematics", "joint_efforts", "joint_positions",
    "joint_reactions", "JointDamper", "JointEffort", "LinearActuator", "linearize",
    "link_energies", "Linkage", "load", "mass_centers", "mass_matrix", "paper",
    "PDController", "plotting", "Point", "references", "save", "Scene", "scenes",
    "simulate", "simulate_sampled", "simulation", "Solution", "SpringDamper", "State",
    "step", "sweep", "tip_jacobian", "tip_position", "TipTask", "to_mjcf", "to_pandas",
    "to_xarray", "TOPOLOGIES", "tune", "TuneResult", "tuning", "Values", "view",
    "Wrench",
]  # fmt: skip


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


if not TYPE_CHECKING:  # a checker of types would then accept any name

    def __getattr__(name):
        # Pictures are imported on first use, as they need matplotlib.
        if name in ("drawing", "plotting"):
            return importlib.import_module(f".pictures.{name}", __name__)
        if name == "view":
            return importlib.import_module(".viewer.view", __name__).view
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
