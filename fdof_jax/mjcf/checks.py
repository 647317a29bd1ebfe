"""Checks of arguments, and words of messages."""

import numpy as np


def plain(text: str) -> str:
    """Returns a text on one line, without control codes, cut if it is long."""
    return "".join(filter(str.isprintable, " ".join(text.split())))[:200]


def refusal(name: str, expected: str, got: object) -> ValueError:
    """Returns the error to raise for a malformed argument."""
    return ValueError(f"{name}: expected {expected}, got {plain(repr(got))}.")


def real_numbers(name: str, values: object, shape: tuple[int, ...]) -> np.ndarray:
    """Returns finite numbers of a shape, or raises ValueError."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):  # also of traced values
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise refusal(name, f"known, finite numbers of shape {shape}", values)
    return array
