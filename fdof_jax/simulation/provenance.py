"""Names what a sweep computes, by a digest that is the same in every process."""

import hashlib
import re
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .batch_axes import Batch
from .chunk_programs import outcome_of
from .solution import Solution


def outline(
    batch: Batch, ts: Array, settings: dict, keep: Callable[[Solution], Any]
) -> tuple[Any, str]:
    """Returns shapes and types of what is kept of a member, and the sweep's digest.

    The digest is of the program and of all arrays. The program names functions, such
    as force elements, by what they compute.
    """

    def kept(ts, moving, shared, settings, keep):
        outcome, _, _ = outcome_of(settings, keep, ts, moving, shared, False)
        return jax.tree.map(jnp.asarray, outcome)

    moving, shared = batch.split()
    first = jax.tree.map(lambda leaf: leaf[0], moving)
    arguments = ts, first, shared, settings, keep
    program, arrays, others = eqx.filter_make_jaxpr(kept)(*arguments)
    # Functions are printed with addresses, which differ between processes.
    text = re.sub(" at 0x[0-9a-f]+", "", str(program))
    digest = hashlib.sha256(text.encode())
    inputs = eqx.filter((batch.inputs, ts, settings, keep), eqx.is_array_like)
    for leaf in jax.tree.leaves((program.consts, inputs)):
        if isinstance(leaf, Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        values = np.ascontiguousarray(leaf)
        digest.update(repr((values.shape, values.dtype)).encode())
        digest.update(values.data.cast("B") if values.size else b"")
    return eqx.combine(arrays, others), digest.hexdigest()
