"""Motion in time: the equations that are integrated, and what is read from them."""

from .efforts import Efforts
from .prescribed import PrescribedMotion

__all__ = [
    "Efforts", "PrescribedMotion",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
