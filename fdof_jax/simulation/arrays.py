"""Motions in arrays instead of tuples of scalars."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ..mechanics.equations import Constants
from ..steps.term import Integrated, ScheduledTerm
from .vector_field import Args


class _Packed(eqx.Module):
    """A tree of scalars as one array of numbers and one of flags."""

    numbers: Array
    flags: Array
    structure: Any = eqx.field(static=True)
    is_flag: tuple[bool, ...] = eqx.field(static=True)

    def scalars(self) -> Constants:
        numbers, flags = iter(self.numbers), iter(self.flags)
        leaves = [next(flags if flag else numbers) for flag in self.is_flag]
        return jax.tree.unflatten(self.structure, leaves)


def _packed(scalars: Constants) -> _Packed:
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, scalars))
    is_flag = tuple(leaf.dtype == bool for leaf in leaves)
    numbers, flags = (
        # Of known joints there are no flags.
        jnp.array([leaf for leaf, flag in zip(leaves, is_flag) if flag == kind], dtype)
        for kind, dtype in ((False, None), (True, bool))
    )
    return _Packed(numbers, flags, structure, is_flag)


def in_arrays(
    term: ScheduledTerm, y: Integrated, args: Args
) -> tuple[ScheduledTerm, Integrated, Args]:
    """Returns term, state and arguments in arrays instead of tuples of scalars.

    Plain calls compile faster with arrays, batches run faster with scalars.
    """
    packed = args._replace(constants=_packed(args.constants))  # pyright: ignore[reportArgumentType]
    return _of_arrays(term), tuple(map(jnp.stack, y)), packed


@functools.cache  # for the same term, so that its functions are traced once
def _of_arrays(term: ScheduledTerm) -> ScheduledTerm:
    def of_scalars(function: Callable) -> Callable:
        def unpacked(t, y, args, *schedule):
            args = args._replace(constants=args.constants.scalars())
            return function(t, tuple(map(tuple, y)), args, *schedule)

        return unpacked

    def first_in_arrays(function: Callable) -> Callable:
        function = of_scalars(function)

        def stacked(*at):
            y, other = function(*at)
            return tuple(map(jnp.stack, y)), other

        return stacked

    def in_arrays_too(function: Callable) -> Callable:
        function = of_scalars(function)
        return lambda *at: tuple(map(jnp.stack, function(*at)))

    return ScheduledTerm(
        in_arrays_too(term.vector_field),
        term.schedule,
        of_scalars(term.health),
        first_in_arrays(term.watched_field),
        of_scalars(term.switching),
        term.unknown_modes,
        term.resolve and first_in_arrays(term.resolve),  # of an event, not a time
        term.settle and in_arrays_too(term.settle),
        term.sample and of_scalars(term.sample),
    )
