from ..simulation.scene import stacked as stacked
from .ensembles import perturbed as perturbed, with_payload as with_payload
from .gradient_quality import (
    GradientReport as GradientReport,
    gradient_report as gradient_report,
)
from .league import circle_scenes as circle_scenes, league_table as league_table
from .limits import Limits as Limits
from .losses import (
    Tracking as Tracking,
    joint_errors as joint_errors,
    tip_errors as tip_errors,
)
from .optimal_motion import (
    OptimalMotion as OptimalMotion,
    optimal_efforts as optimal_efforts,
)
from .result import TradeOff as TradeOff, TuneResult as TuneResult
from .tuning import trade_off as trade_off, tune as tune, tune_each as tune_each
from .within_limits import TunedWithin as TunedWithin, tune_within as tune_within

__all__: list[str]
