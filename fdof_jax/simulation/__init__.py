"""Motion in time: its equations, and what is read from them."""

from ..base.functions import jit
from .diffrax_term import ode_term
from .efforts import Efforts
from .jacobian import Sensitivities, sensitivities
from .prescribed import PrescribedMotion
from .scene import accepts_scene
from .solution import Events
from .until import End, Until

__all__ = [
    "accepts_scene", "Efforts", "End", "Events", "jit", "ode_term", "PrescribedMotion",
    "Sensitivities", "sensitivities", "Until",
]  # fmt: skip
__dir__ = __all__.copy
