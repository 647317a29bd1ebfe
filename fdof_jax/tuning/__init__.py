"""Gain tuning by gradients."""

from ..simulation.scene import stacked
from .ensembles import perturbed, with_payload
from .losses import Tracking, joint_errors, tip_errors
from .result import TuneResult
from .tuning import tune
from .within_limits import Limits, TunedWithin, tune_within

__all__ = [
    "joint_errors", "Limits", "perturbed",
    "stacked", "tip_errors", "Tracking", "tune", "tune_within", "TunedWithin",
    "TuneResult", "with_payload",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
