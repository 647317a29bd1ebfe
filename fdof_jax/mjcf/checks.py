"""Known numbers in double precision."""

import numpy as np

from ..checks import refusal


def real_numbers(name: str, values: object, shape: tuple[int, ...]) -> np.ndarray:
    """Returns finite numbers of a shape, or raises ValueError."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):  # also of traced values
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise refusal(name, f"known, finite numbers of shape {shape}", values)
    return array
