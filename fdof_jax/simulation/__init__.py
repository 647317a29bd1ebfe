"""Motion in time: the equations that are integrated, and what is read from them."""

from .efforts import Efforts
from .diffrax_term import ode_term
from .prescribed import PrescribedMotion

__all__ = [
    "Efforts", "PrescribedMotion", "ode_term",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
