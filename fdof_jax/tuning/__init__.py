"""Gain tuning by gradients, optimal efforts, and checks of the gradients."""

from ..simulation.scene import stacked
from .ensembles import circle_scenes, perturbed, with_payload
from .gradient_quality import GradientReport, gradient_report
from .losses import Tracking, joint_errors, tip_errors
from .optimal_motion import OptimalMotion, optimal_efforts
from .result import TradeOff, TuneResult, league_table
from .tuning import trade_off, tune, tune_each
from .within_limits import Limits, TunedWithin, tune_within

__all__ = [
    "circle_scenes", "gradient_report", "GradientReport", "joint_errors",
    "league_table", "Limits", "optimal_efforts", "OptimalMotion", "perturbed",
    "stacked", "tip_errors", "Tracking", "trade_off", "TradeOff", "tune",
    "tune_each", "tune_within", "TunedWithin", "TuneResult", "with_payload",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
