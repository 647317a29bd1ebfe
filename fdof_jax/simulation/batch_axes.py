"""Finds the arrays of a linkage, a state and forces that carry a batch axis."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..forces.element import Forces
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage

# Dimensions of a single linkage's fields; one more is a batch axis.
_LINKAGE_RANKS = dict(
    ef=1, length=1, com=2, mass=1, inertia=1, locked=1, base_angle=0, gravity=0
)


class Batch(NamedTuple):
    """Inputs of all members, and each leaf's batch axis (-1: shared)."""

    inputs: tuple[Linkage, State, Forces]
    axes: Any
    size: int

    def split(self) -> tuple[Any, Any]:
        return eqx.partition(
            self.inputs, jax.tree.map(lambda axis: axis == 0, self.axes)
        )


def _expanded(axis: Any, part: Any) -> Any:
    """Returns the batch axis of each leaf of a part of the forces, or -1."""
    if axis is not None and (type(axis) is not int or axis != 0):
        raise ValueError
    return jax.tree.map(
        lambda leaf: 0 if axis == 0 and eqx.is_array_like(leaf) else -1, part
    )


def _name(part: Any, *rest: Any) -> str:
    """Returns the name of a leaf of the inputs from its path."""
    return ("linkage", "state0", "forces")[part.idx] + jax.tree_util.keystr(rest)


def batch_of(linkage: Linkage, state0: Any, forces: Forces, forces_axes: Any) -> Batch:
    """Returns the inputs as a batch; raises ValueError if their shapes do not fit."""
    linkage_axes = []
    for name, rank in _LINKAGE_RANKS.items():
        extra = vars(linkage)[name].ndim - rank
        if extra not in (0, 1):
            raise ValueError(
                f"linkage.{name}: expected {rank} dimensions or a batch axis before "
                f"them, got shape {vars(linkage)[name].shape}."
            )
        linkage_axes.append(0 if extra else -1)
    state_axes = []
    for name, value in zip(("q", "qd"), state0):
        real = value.dtype.kind in "iuf"
        if not real or value.ndim not in (1, 2) or value.shape[-1] != 3:
            raise ValueError(
                f"state0.{name}: expected real numbers of shape (3,) or (batch, 3), "
                f"got {value.dtype} of shape {value.shape}."
            )
        state_axes.append(0 if value.ndim == 2 else -1)
    try:
        expanded = jax.tree.map(
            _expanded, forces_axes, forces, is_leaf=lambda axis: axis is None
        )
    except ValueError:
        raise ValueError(
            "forces_axes: expected 0, None or a tuple of these with one entry per "
            f"element, got {forces_axes!r}."
        ) from None
    inputs = (linkage, state0, forces)
    by_name = eqx.tree_at(
        lambda x: [vars(x)[name] for name in _LINKAGE_RANKS], linkage, linkage_axes
    )
    axes = (by_name, State(*state_axes), expanded)
    paths, _ = jax.tree_util.tree_flatten_with_path(inputs)
    sizes = {
        _name(*path): np.shape(leaf)[:1]
        for (path, leaf), axis in zip(paths, jax.tree.leaves(axes))
        if axis == 0
    }
    different = set(sizes.values())
    if len(different) != 1 or different <= {(), (0,)}:
        got = [
            f"{name}: {size[0] if size else 'no axis'}" for name, size in sizes.items()
        ]
        raise ValueError(
            "linkage, state0, forces: expected a leading batch axis of one size on at "
            f"least one array, got {', '.join(got) or 'none on any'}."
        )
    return Batch(inputs, axes, different.pop()[0])
