from . import scenes as scenes
from .actuators import Armature as Armature, LinearActuator as LinearActuator
from .batched import sweep as sweep
from .chain_dynamics import (
    bias_force as bias_force,
    constraint_forces as constraint_forces,
    masked_accelerations as masked_accelerations,
    mass_matrix as mass_matrix,
)
from .configuration import configure as configure
from .control import (
    CircleTask as CircleTask,
    PDController as PDController,
    reachable as reachable,
)
from .drives import (
    DCMotor as DCMotor,
    FirstOrderLag as FirstOrderLag,
    PIDController as PIDController,
    SpeedLimit as SpeedLimit,
)
from .dynamics import (
    energy as energy,
    forward_dynamics as forward_dynamics,
    inertia_ratios as inertia_ratios,
    inverse_dynamics as inverse_dynamics,
    link_energies as link_energies,
)
from .ensembles import (
    perturbed as perturbed,
    stacked as stacked,
    with_payload as with_payload,
)
from .files import load as load, save as save
from .fit_result import FitResult as FitResult
from .forces import (
    EffortHistory as EffortHistory,
    InertialElement as InertialElement,
    JointDamper as JointDamper,
    JointEffort as JointEffort,
    StatefulElement as StatefulElement,
)
from .gradient_quality import (
    GradientReport as GradientReport,
    gradient_report as gradient_report,
)
from .hybrid_dynamics import PrescribedMotion as PrescribedMotion
from .identification import fit as fit, fit_each as fit_each, link_ends as link_ends
from .interop import to_mjcf as to_mjcf
from .joint_limits import JointFriction as JointFriction, JointStops as JointStops
from .kinematics import (
    inverse_kinematics as inverse_kinematics,
    joint_positions as joint_positions,
    mass_centers as mass_centers,
    tip_jacobian as tip_jacobian,
    tip_position as tip_position,
)
from .league import circle_scenes as circle_scenes, league_table as league_table
from .linearization import (
    Linearization as Linearization,
    Modes as Modes,
    closed_loop_modes as closed_loop_modes,
    equilibrium as equilibrium,
    holding_efforts as holding_efforts,
    inertial_parameters as inertial_parameters,
    linearize as linearize,
    regressor as regressor,
)
from .linkage import (
    TOPOLOGIES as TOPOLOGIES,
    Linkage as Linkage,
    State as State,
    existence_factors as existence_factors,
    from_chain as from_chain,
    to_chain as to_chain,
)
from .losses import Tracking as Tracking, tip_errors as tip_errors
from .model_based_control import (
    ComputedTorque as ComputedTorque,
    GravityFeedforward as GravityFeedforward,
)
from .optimal_motion import (
    OptimalMotion as OptimalMotion,
    optimal_efforts as optimal_efforts,
)
from .point_elements import (
    SpringDamper as SpringDamper,
    Tension as Tension,
    Wrench as Wrench,
)
from .points import Load as Load, Point as Point, PointElement as PointElement
from .reactions import joint_reactions as joint_reactions
from .references import (
    Ellipse as Ellipse,
    FigureEight as FigureEight,
    JointMove as JointMove,
    Line as Line,
    Path as Path,
    Spline as Spline,
    TipTask as TipTask,
)
from .sampled_control import (
    SampledMotion as SampledMotion,
    simulate_sampled as simulate_sampled,
    step as step,
)
from .scenes import Scene as Scene
from .simulation import joint_efforts as joint_efforts, simulate as simulate
from .solution import Efforts as Efforts, Solution as Solution
from .step_control import scale_tolerances as scale_tolerances
from .tables import to_pandas as to_pandas, to_xarray as to_xarray
from .travel import Laps as Laps, Travel as Travel, shock_against as shock_against
from .tune_result import TradeOff as TradeOff, TuneResult as TuneResult
from .tuning import trade_off as trade_off, tune as tune, tune_each as tune_each

__version__: str
