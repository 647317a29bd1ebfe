"""Names what a sweep computes, by a digest that is the same in every process."""

import hashlib
import re
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from ..base.checks import refusal
from ..simulation.solution import Solution
from .batch_axes import Batch
from .chunk_programs import outcome_of


def _check_callback(operation: JaxprEqn) -> None:
    """Raises ValueError if an operation takes its results from a Python function."""
    if operation.primitive.name not in ("pure_callback", "io_callback"):
        return
    function = operation.params["callback"].callback_func
    # Run-time checks by equinox add nothing to results.
    if not str(getattr(function, "__module__", "")).startswith("equinox."):
        expected = "a sweep without functions that only Python can call"
        raise refusal("checkpoint, store", expected, function)


def _constants(program: ClosedJaxpr | Jaxpr) -> Iterator[Any]:
    """Yields the arrays that a program holds, and the programs within it.

    Raises ValueError if it calls a Python function, which no digest can name.
    """
    yield from getattr(program, "consts", ())  # an open Jaxpr has none in JAX 0.10
    programs = ClosedJaxpr, Jaxpr
    for operation in program.eqns:
        _check_callback(operation)
        leaves = jax.tree.leaves(
            operation.params, is_leaf=lambda leaf: isinstance(leaf, programs)
        )
        for leaf in leaves:
            if isinstance(leaf, programs):
                yield from _constants(leaf)


def outline(
    batch: Batch, ts: Array, settings: dict, keep: Callable[[Solution], Any]
) -> tuple[Any, str]:
    """Returns shapes and types of what is kept of a member, and the sweep's digest.

    The digest is of the program and of all arrays. The program names functions, such
    as force elements, by what they compute. Raises ValueError for callbacks into
    Python.
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
    for leaf in [*_constants(program), *jax.tree.leaves(inputs)]:
        if isinstance(leaf, Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        values = np.ascontiguousarray(leaf)
        digest.update(repr((values.shape, values.dtype)).encode())
        digest.update(values.data.cast("B") if values.size else b"")
    return eqx.combine(arrays, others), digest.hexdigest()
