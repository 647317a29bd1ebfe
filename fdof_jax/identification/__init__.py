"""Identification of an arm's parameters from recorded motions."""

from .design import NextMotion, next_motion
from .fitting import fit, fit_each
from .problems import link_ends
from .result import FitResult

__all__ = [
    "fit", "fit_each", "FitResult", "link_ends", "next_motion", "NextMotion",
]  # fmt: skip
__dir__ = __all__.copy
