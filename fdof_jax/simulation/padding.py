"""Rows of output times, padded so that few programs serve all numbers of them."""

import jax
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

# All plain calls with at most this many output times share one program.
_FEWEST_TIMES = 512


def padded(rows: PyTree) -> PyTree:
    """Returns arrays (time, ...) with their last row repeated up to a power of two."""

    def longer(row: ArrayLike) -> np.ndarray:
        array = np.asarray(row)
        count = len(array)
        size = max(_FEWEST_TIMES, 1 << (count - 1).bit_length())
        others = ((0, 0),) * (array.ndim - 1)
        return np.pad(array, ((0, size - count), *others), mode="edge")

    return jax.tree.map(longer, rows)


def cut(rows: PyTree, count: int) -> PyTree:
    """Returns the first `count` rows of arrays (time, ...)."""
    # JAX slices and jnp.asarray would compile a program for each new shape.
    return jax.device_put(jax.tree.map(lambda row: np.asarray(row)[:count], rows))
