"""Finds the arrays of a linkage, a state and forces that carry a batch axis."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import Array
from jaxtyping import PyTree

from ..base.checks import instance, refusal
from ..forces.element import Forces
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage

ForcesAxes = int | tuple[int | None, ...] | None  # 0 or None, for each element or all

# Dimensions of the arrays of a single linkage and state; one more is a batch axis.
_RANKS = dict(
    ef=1, length=1, com=2, mass=1, inertia=1, locked=1, base_angle=0, gravity=0,
    q=1, qd=1,
)  # fmt: skip


class Batch(NamedTuple):
    moving: PyTree  # their arrays with a batch axis, and None for other leaves
    shared: PyTree  # their other leaves, and None for these
    size: int


def _name(part: Any, *rest: object) -> str:
    """Returns the name of a leaf of the inputs from its path."""
    return ("linkage", "state0", "forces")[part.idx] + jax.tree_util.keystr(rest)


def _has_axis(path: tuple[Any, ...], array: Array | np.ndarray, joints: int) -> bool:
    rank, shape = _RANKS[path[-1].name], array.shape
    fits = array.ndim - rank in (0, 1) and array.dtype.kind in "iuf"
    if not fits or path[-1].name in State._fields and shape[-1] != joints:
        own = f"({joints},)" if path[-1].name in State._fields else f"{rank} dimensions"
        raise ValueError(
            f"{_name(*path)}: expected real numbers of {own}, with or without a "
            f"leading batch axis, got {array.dtype} of shape {shape}."
        )
    return array.ndim > rank


def _force_has_axis(axis: int | None, part: PyTree) -> PyTree:
    if axis is not None and (type(axis) is not int or axis != 0):
        raise ValueError
    return jax.tree.map(lambda leaf: axis == 0 and eqx.is_array_like(leaf), part)


def batch_of(
    linkage: Linkage, state0: State, forces: Forces, forces_axes: ForcesAxes
) -> Batch:
    """Returns the inputs as a batch; raises ValueError if their shapes do not fit."""
    if isinstance(linkage, list | tuple) and linkage:
        raise ValueError(
            f"linkage: expected one Linkage with a batch axis, got {len(linkage)} in a "
            "sequence; jax.tree.map(lambda *x: jnp.stack(x), *arms) stacks arms."
        )
    instance("linkage", linkage, Linkage)
    inputs = linkage, state0, forces
    leaves, structure = jax.tree_util.tree_flatten_with_path(inputs)
    joints = linkage.ef.shape[-1] // 2
    batched = [
        _has_axis(path, leaf, joints) for path, leaf in leaves if path[0].idx < 2
    ]
    try:
        none = lambda axis: axis is None
        of_forces = jax.tree.map(_force_has_axis, forces_axes, forces, is_leaf=none)
        batched += jax.tree.leaves(of_forces)
    except ValueError:
        expected = "0, None or a tuple of these with one entry per element"
        raise refusal("forces_axes", expected, forces_axes) from None
    axes = [
        (path, np.shape(leaf)[:1])
        for (path, leaf), has_axis in zip(leaves, batched)
        if has_axis
    ]
    different = {size for _, size in axes}
    if different == {(0,)}:
        raise ValueError(
            "linkage, state0, forces: expected a batch of at least one member, got 0."
        )
    if len(different) != 1 or different == {()}:
        got = [
            f"{_name(*path)}: {size[0] if size else 'no axis'}" for path, size in axes
        ]
        unsaid = forces and not (got or jax.tree.leaves(forces_axes))
        hint = " (pass forces_axes=0 if those of `forces` have one)" if unsaid else ""
        raise ValueError(
            "linkage, state0, forces: expected a leading batch axis of one size on at "
            f"least one array, got {', '.join(got) or 'none on any'}{hint}."
        )
    # `equinox.partition` takes four times as long, which small sweeps would feel.
    moving = [leaf if axis else None for (_, leaf), axis in zip(leaves, batched)]
    shared = [None if axis else leaf for (_, leaf), axis in zip(leaves, batched)]
    whole = structure.unflatten
    return Batch(whole(moving), whole(shared), different.pop()[0])
