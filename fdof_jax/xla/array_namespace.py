"""Lines that evaluate in NumPy as well as in JAX.

At the door of `simulate` a few numbers are looked at once. NumPy does that in less than
a millisecond; JAX would first compile a program, for a hundred times as long.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .trigonometry import sincos


def in_numpy(tree: Any) -> Any:
    """`tree` with NumPy arrays for its JAX arrays, except for traced ones."""

    def converted(leaf: Any) -> Any:
        # Random keys are JAX arrays that NumPy has no type for.
        numbers = isinstance(leaf, jax.Array) and isinstance(leaf.dtype, np.dtype)
        return np.asarray(leaf) if numbers and not isinstance(leaf, Tracer) else leaf

    return jax.tree.map(converted, tree)


def namespace(*trees: Any) -> Any:
    """`jax.numpy` if any leaf of `trees` is a JAX array, else `numpy`."""
    leaves = jax.tree.leaves(trees)
    return jnp if any(isinstance(leaf, jax.Array) for leaf in leaves) else np


def sine_and_cosine(angle: Any) -> tuple[Any, Any]:
    """Sine and cosine of `angle`, by `sincos` for a JAX array."""
    if namespace(angle) is jnp:
        return sincos(angle)
    return np.sin(angle), np.cos(angle)


def plane_vector(x: Any, y: Any) -> Any:
    """x + iy."""
    # In JAX a product with 1j would be computed, and differentiated.
    return jax.lax.complex(x, y) if namespace(x, y) is jnp else x + 1j * y
