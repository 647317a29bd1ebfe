from .design import NextMotion as NextMotion, next_motion as next_motion
from .fitting import fit as fit, fit_each as fit_each
from .recordings import link_ends as link_ends
from .result import FitResult as FitResult

__all__: list[str]
