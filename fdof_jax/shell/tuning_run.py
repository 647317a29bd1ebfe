"""The choices of `fdof-jax tune`, as plain data: the command line shows them at once,
without JAX.
"""

import dataclasses
from collections.abc import Sequence

# The names of `bounded_search.METHODS`.
METHODS = ("levenberg-marquardt", "l-bfgs", "adam")


@dataclasses.dataclass(frozen=True)
class Job:
    """The task of Fig 7's arm on a circle, and the loss by which its gains are tuned.

    `over`: "nominal", or "mean" or "worst" of an ensemble of `members`.
    """

    center: Sequence[float] = (-4.0, 2.0)  # [m]
    radius: float = 0.75  # [m]
    period: float = 5.0  # [s]
    factor: float = 4.0  # of the paper's gains
    price: float = 0.0  # of effort [m^2]
    over: str = "nominal"
    members: int = 16
    payload: Sequence[float] = (0.0, 2.0)  # [kg]
    start_offset: float = 0.3  # [m]
    speed: Sequence[float] = (1.0, 2.0)
    link_error: float = 0.0
