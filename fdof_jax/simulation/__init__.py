"""Motion in time: the equations that are integrated, and what is read from them."""

from .conditions import End, Until
from .diffrax_term import ode_term
from .efforts import Efforts
from .prescribed import PrescribedMotion

__all__ = [
    "Efforts", "End", "PrescribedMotion", "Until", "ode_term",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
