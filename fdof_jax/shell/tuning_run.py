"""The options of `fdof-jax tune` as plain data, which need no import of JAX."""

import dataclasses
from collections.abc import Sequence

# The names in `search.methods.METHODS`, copied so that JAX need not be imported.
METHODS = ("levenberg-marquardt", "l-bfgs")


@dataclasses.dataclass(frozen=True)
class Job:
    """The circle of Fig 7's arm, and the loss that its gains minimise.

    `over`: "nominal", or "mean" or "worst" of an ensemble of `members`.
    """

    center: Sequence[float] = (-4.0, 2.0)  # [m]
    radius: float = 0.75  # [m]
    period: float = 5.0  # [s]
    factor: float = 4.0  # bounds of the gains, relative to the paper's
    price: float = 0.0  # of effort [m^2]
    over: str = "nominal"
    members: int = 16
    payload: Sequence[float] = (0.0, 2.0)  # [kg]
    start_offset: float = 0.3  # [m]
    speed: Sequence[float] = (1.0, 2.0)
    link_error: float = 0.0
