"""Known values in NumPy, and functions of them as one compiled program."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from .checks import is_traced


def in_numpy(tree: PyTree) -> PyTree:
    """Returns `tree` with its concrete JAX arrays as NumPy arrays."""

    def converted(leaf: object) -> object:
        # NumPy has no dtype for random keys.
        numbers = isinstance(leaf, jax.Array) and isinstance(leaf.dtype, np.dtype)
        return np.asarray(leaf) if numbers and not isinstance(leaf, Tracer) else leaf

    return jax.tree.map(converted, tree)


def known_array(values: ArrayLike) -> Array:
    """Returns an array of JAX that is known also within transformations."""
    with jax.ensure_compile_time_eval():
        return jnp.asarray(values, float)


def at_once(function: Callable) -> Callable:
    """Decorates a function, which runs as one compiled program if arguments are known.

    Its results are then known too, also within transformations.
    """
    program = eqx.filter_jit(function)

    @functools.wraps(function)
    def run(*arguments: PyTree) -> PyTree:
        if is_traced(arguments):
            return function(*arguments)
        with jax.ensure_compile_time_eval():
            return program(*arguments)

    return run
