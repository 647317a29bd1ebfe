from . import scenes as scenes
from .analysis.equilibrium import (
    equilibrium as equilibrium,
    holding_efforts as holding_efforts,
)
from .analysis.linearization import (
    Linearization as Linearization,
    Modes as Modes,
    closed_loop_modes as closed_loop_modes,
    linearize as linearize,
)
from .analysis.reactions import joint_reactions as joint_reactions
from .analysis.regressor import (
    inertial_parameters as inertial_parameters,
    regressor as regressor,
)
from .control.circle import CircleTask as CircleTask
from .control.drives import (
    DCMotor as DCMotor,
    FirstOrderLag as FirstOrderLag,
    PIDController as PIDController,
    SpeedLimit as SpeedLimit,
)
from .control.model_based import (
    ComputedTorque as ComputedTorque,
    GravityFeedforward as GravityFeedforward,
)
from .control.paths import (
    Ellipse as Ellipse,
    FigureEight as FigureEight,
    Line as Line,
    Path as Path,
    Spline as Spline,
)
from .control.pd import PDController as PDController
from .control.reference import Reference as Reference, reachable as reachable
from .control.task import JointMove as JointMove, TipTask as TipTask
from .control.timing import (
    Laps as Laps,
    Travel as Travel,
    shock_against as shock_against,
)
from .data.files import load as load, save as save
from .data.mjcf import to_mjcf as to_mjcf
from .data.tables import to_pandas as to_pandas, to_xarray as to_xarray
from .dynamics import (
    energy as energy,
    forward_dynamics as forward_dynamics,
    inertia_ratios as inertia_ratios,
    inverse_dynamics as inverse_dynamics,
    joint_bias as joint_bias,
    joint_mass_matrix as joint_mass_matrix,
    link_energies as link_energies,
)
from .forces.actuators import Armature as Armature, LinearActuator as LinearActuator
from .forces.between_points import (
    SpringDamper as SpringDamper,
    Tension as Tension,
    Wrench as Wrench,
)
from .forces.element import (
    Element as Element,
    InertialElement as InertialElement,
    StatefulElement as StatefulElement,
)
from .forces.joint_limits import (
    JointFriction as JointFriction,
    JointStops as JointStops,
)
from .forces.joints import (
    EffortHistory as EffortHistory,
    JointDamper as JointDamper,
    JointEffort as JointEffort,
)
from .forces.part import (
    Condition as Condition,
    Values as Values,
    field as field,
)
from .forces.points import Load as Load, Point as Point, PointElement as PointElement
from .identification.fit import fit as fit, fit_each as fit_each, link_ends as link_ends
from .identification.result import FitResult as FitResult
from .linkage.coordinates import (
    State as State,
    from_chain as from_chain,
    to_chain as to_chain,
)
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
from .simulation.prescribed import PrescribedMotion as PrescribedMotion
from .simulation.sampled import (
    SampledMotion as SampledMotion,
    simulate_sampled as simulate_sampled,
    step as step,
)
from .simulation.scene import Scene as Scene, stacked as stacked
from .simulation.simulate import joint_efforts as joint_efforts, simulate as simulate
from .simulation.solution import Efforts as Efforts, Solution as Solution
from .simulation.steps import scale_tolerances as scale_tolerances
from .simulation.sweep import sweep as sweep
from .tuning.ensembles import perturbed as perturbed, with_payload as with_payload
from .tuning.gradient_quality import (
    GradientReport as GradientReport,
    gradient_report as gradient_report,
)
from .tuning.league import circle_scenes as circle_scenes, league_table as league_table
from .tuning.losses import Tracking as Tracking, tip_errors as tip_errors
from .tuning.optimal_motion import (
    OptimalMotion as OptimalMotion,
    optimal_efforts as optimal_efforts,
)
from .tuning.result import TradeOff as TradeOff, TuneResult as TuneResult
from .tuning.tune import trade_off as trade_off, tune as tune, tune_each as tune_each
from .xla.configuration import configure as configure

__version__: str
__all__: list[str]
