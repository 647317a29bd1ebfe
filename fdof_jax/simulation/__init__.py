"""Motion in time: the equations that are integrated, and what is read from them."""

from .conditions import Until
from .diffrax_term import ode_term
from .efforts import Efforts
from .prescribed import PrescribedMotion
from .scene import accepts_scene

__all__ = [
    "accepts_scene", "Efforts", "ode_term", "PrescribedMotion", "Until",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
