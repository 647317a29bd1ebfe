"""Motion in time: the equations that are integrated, and what is read from them."""

from .efforts import Efforts
from .prescribed import PrescribedMotion
from .sampled import SampledMotion

__all__ = [
    "Efforts", "PrescribedMotion", "SampledMotion",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
