"""Motion in time: its equations, and what is read from them."""

from .conditions import End, Until
from .diffrax_term import ode_term
from .efforts import Efforts
from .prescribed import PrescribedMotion
from .scene import accepts_scene
from .solution import Events

__all__ = [
    "accepts_scene", "Efforts", "End", "Events", "ode_term", "PrescribedMotion",
    "Until",
]  # fmt: skip
__dir__ = __all__.copy
