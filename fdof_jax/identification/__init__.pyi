from .fitting import fit as fit, fit_each as fit_each
from .recordings import link_ends as link_ends
from .result import FitResult as FitResult

__all__: list[str]
