"""Operations on trees of arrays."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree


def constant(tree: PyTree) -> PyTree:
    """Returns the tree with its arrays constant for derivatives."""
    return jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree
    )


def chosen(condition: ArrayLike, ones: PyTree, others: PyTree) -> PyTree:
    """Returns the numbers of one tree where a condition holds, else of another."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), ones, others)


def largest(tree: PyTree) -> Array:
    """Returns the size of the largest number in a tree."""
    sizes = [jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]
    return functools.reduce(jnp.maximum, sizes)


def per_member(tree: PyTree, of: PyTree) -> PyTree:
    """Returns the tree, whose numbers are one per member wherever those of `of` are.

    What a custom rule returns must be so, also where it is the same for all members:
    JAX takes values and tangents to be batched alike. It is linear in `of`, which may
    be tangents. It costs nothing in forward mode; reverse mode transposes what is in
    `of`, too, which XLA does not remove across loops.
    """
    numbers = jax.tree.leaves(eqx.filter(of, eqx.is_inexact_array))
    member = sum(map(jnp.sum, numbers))
    return jax.tree.map(lambda x: jnp.where(False, member, x), tree)
