"""Gain tuning by gradients."""

from .losses import Tracking, joint_errors, tip_errors
from .result import TuneResult
from .stacks import stacked
from .tuning import tune
from .within_limits import Limits, TunedWithin, tune_within

__all__ = [
    "joint_errors", "Limits", "stacked", "tip_errors", "Tracking", "tune",
    "tune_within", "TunedWithin", "TuneResult",
]  # fmt: skip
__dir__ = __all__.copy
