from . import (
    analysis as analysis,
    control as control,
    data as data,
    forces as forces,
    identification as identification,
    references as references,
    scenes as scenes,
    tuning as tuning,
)
from .analysis.linearization import linearize as linearize
from .analysis.reactions import joint_reactions as joint_reactions
from .base.configuration import configure as configure
from .batches.sweep import sweep as sweep
from .control.pd import PDController as PDController
from .data.files import load as load, save as save
from .data.mjcf import to_mjcf as to_mjcf
from .data.mjcf_import import from_mjcf as from_mjcf
from .data.tables import to_pandas as to_pandas, to_xarray as to_xarray
from .dynamics import (
    energy as energy,
    forward_dynamics as forward_dynamics,
    inverse_dynamics as inverse_dynamics,
    joint_bias as joint_bias,
    joint_mass_matrix as joint_mass_matrix,
    link_energies as link_energies,
)
from .forces.actuators import LinearActuator as LinearActuator
from .forces.between_points import SpringDamper as SpringDamper, Wrench as Wrench
from .forces.element import Element as Element
from .forces.joints import JointDamper as JointDamper, JointEffort as JointEffort
from .forces.points import Point as Point
from .identification.fitting import fit as fit
from .identification.result import FitResult as FitResult
from .linkage.coordinates import (
    State as State,
    from_chain as from_chain,
    to_chain as to_chain,
)
from .linkage.fields import Values as Values, field as field
from .linkage.linkage import Linkage as Linkage
from .linkage.topology import (
    TOPOLOGIES as TOPOLOGIES,
    existence_factors as existence_factors,
)
from .mechanics.inverse_kinematics import inverse_kinematics as inverse_kinematics
from .mechanics.kinematics import (
    joint_positions as joint_positions,
    mass_centers as mass_centers,
    tip_jacobian as tip_jacobian,
    tip_position as tip_position,
)
from .mechanics.paper import (
    bias_force as bias_force,
    constraint_forces as constraint_forces,
    masked_accelerations as masked_accelerations,
    mass_matrix as mass_matrix,
)
from .pictures import (
    drawing as drawing,
    interactive as interactive,
    plotting as plotting,
)
from .references.circle import CircleTask as CircleTask
from .references.task import TipTask as TipTask
from .simulation.efforts import Efforts as Efforts, joint_efforts as joint_efforts
from .simulation.prescribed import PrescribedMotion as PrescribedMotion
from .simulation.sampled import (
    SampledMotion as SampledMotion,
    simulate_sampled as simulate_sampled,
    step as step,
)
from .simulation.scene import Scene as Scene
from .simulation.simulate import simulate as simulate
from .simulation.solution import Solution as Solution
from .steps.tolerances import scale_tolerances as scale_tolerances
from .tuning.result import TuneResult as TuneResult
from .tuning.tuning import tune as tune

__version__: str
__all__: list[str]
