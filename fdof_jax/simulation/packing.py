"""The equations of motion for arrays instead of tuples of scalars.

XLA compiles a kernel for each array that changes in a loop or is computed for it, in
much the same time for one number as for many. Plain calls use arrays. Batches are
faster with scalars.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ..steps.dopri8 import ScheduledTerm
from .field import Args


class _Packed(eqx.Module):
    """A tree of scalars as one array of numbers and one of flags."""

    numbers: Array
    flags: Array
    structure: Any = eqx.field(static=True)
    is_flag: tuple[bool, ...] = eqx.field(static=True)

    def scalars(self) -> Any:
        numbers, flags = iter(self.numbers), iter(self.flags)
        leaves = [next(flags if flag else numbers) for flag in self.is_flag]
        return jax.tree.unflatten(self.structure, leaves)


def _packed(scalars: Any) -> _Packed:
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, scalars))
    is_flag = tuple(leaf.dtype == bool for leaf in leaves)
    numbers, flags = (
        jnp.stack([leaf for leaf, flag in zip(leaves, is_flag) if flag == kind])
        for kind in (False, True)
    )
    return _Packed(numbers, flags, structure, is_flag)


def in_arrays(
    term: ScheduledTerm, y: Any, args: Args
) -> tuple[ScheduledTerm, Any, Any]:
    """Returns term, state and arguments in arrays."""
    packed = args._replace(constants=_packed(args.constants))  # pyright: ignore[reportArgumentType]
    return _of_arrays(term), tuple(map(jnp.stack, y)), packed


@functools.cache  # for the same term, so that its functions are traced once
def _of_arrays(term: ScheduledTerm) -> ScheduledTerm:
    def of_scalars(function: Callable) -> Callable:
        def unpacked(t, y, args, *schedule):
            args = args._replace(constants=args.constants.scalars())
            return function(t, tuple(map(tuple, y)), args, *schedule)

        return unpacked

    field, watched = map(of_scalars, (term.vector_field, term.watched_field))

    def watched_field(*at):
        rates, health = watched(*at)
        return tuple(map(jnp.stack, rates)), health

    return ScheduledTerm(
        lambda *at: tuple(map(jnp.stack, field(*at))),
        term.schedule,
        of_scalars(term.health),
        watched_field,
        of_scalars(term.switching),
    )
