"""Helpers for code that runs in NumPy as well as in JAX.

`simulate` checks a few concrete numbers once per call. NumPy does so in less than a
millisecond; JAX would first compile a program, which takes a hundred times as long.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .trigonometry import sincos


def in_numpy(tree: Any) -> Any:
    """Returns `tree` with its concrete JAX arrays as NumPy arrays."""

    def converted(leaf: Any) -> Any:
        # NumPy has no dtype for random keys.
        numbers = isinstance(leaf, jax.Array) and isinstance(leaf.dtype, np.dtype)
        return np.asarray(leaf) if numbers and not isinstance(leaf, Tracer) else leaf

    return jax.tree.map(converted, tree)


def namespace(*trees: Any) -> Any:
    """Returns `jax.numpy` if any leaf of `trees` is a JAX array, else `numpy`."""
    leaves = jax.tree.leaves(trees)
    return jnp if any(isinstance(leaf, jax.Array) for leaf in leaves) else np


def sine_and_cosine(angle: Any) -> tuple[Any, Any]:
    """Computes sine and cosine of `angle`, with `sincos` for a JAX array."""
    if namespace(angle) is jnp:
        return sincos(angle)
    return np.sin(angle), np.cos(angle)


def plane_vector(x: Any, y: Any) -> Any:
    """Returns x + iy."""
    # JAX would compute and differentiate a product with 1j.
    return jax.lax.complex(x, y) if namespace(x, y) is jnp else x + 1j * y


def plane_vectors(points: Any) -> Any:
    """Returns x + iy of points (..., 2)."""
    return plane_vector(points[..., 0], points[..., 1])
