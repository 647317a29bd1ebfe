"""Scenes of one structure as one scene."""

from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from .. import Scene
from ..checks import instance, refusal, shown

_Stacked = TypeVar("_Stacked")


def _is_number(leaf: object) -> bool:
    """Returns whether a leaf of a scene is data: an array or a float."""
    return eqx.is_array_like(leaf) and not isinstance(leaf, bool | int)


def _as_array(leaf: ArrayLike) -> np.ndarray:
    array = np.asarray(leaf)
    floating = array.dtype.kind == "f"
    return array.astype(jnp.result_type(float)) if floating else array


def _parts(scene: PyTree) -> tuple[PyTree, PyTree]:
    if isinstance(scene, Scene):  # whose end time may be an integer
        scene = scene._replace(t1=np.asarray(scene.t1, float))
    return eqx.partition(scene, _is_number)


def stacked(scenes: Sequence[_Stacked], name: str = "scenes") -> _Stacked:
    """Stacks scenes of one structure into one, with a leading axis on every array.

    **Raises:** ValueError for scenes of different structure.

    >>> import fdof_jax as fj
    >>> short = fj.scenes.fig7()._replace(t1=2.0)
    >>> fj.tuning.stacked([short, short]).linkage.mass.shape
    (2, 3)
    """
    if not isinstance(scenes, list | tuple) or isinstance(scenes, Scene) or not scenes:
        raise refusal(name, "a list of scenes", scenes)
    numbers, others = zip(*map(_parts, scenes))
    shapes = [jax.tree.map(np.shape, tree) for tree in numbers]
    for index, (other, shape) in enumerate(zip(others, shapes)):
        if not eqx.tree_equal(other, others[0]) or shape != shapes[0]:
            raise ValueError(
                f"{name}[{index}]: expected one like {name}[0] except for numbers, got "
                f"{shown(scenes[index])} and {shown(scenes[0])}."
            )
    stack = lambda *leaves: np.stack([*map(_as_array, leaves)])
    return eqx.combine(jax.tree.map(stack, *numbers), others[0])


def unstacked(name: str, scenes: Scene) -> list[Scene]:
    instance(name, scenes, Scene)
    arrays, rest = eqx.partition(scenes, _is_number)
    leaves, structure = jax.tree.flatten(arrays)
    sizes = {np.shape(leaf)[:1] for leaf in leaves}
    if len(sizes) != 1 or sizes <= {(), (0,)}:
        expected = "scenes stacked along a leading axis of one size (see `stacked`)"
        raise refusal(name, expected, scenes)
    rows = (jax.device_put(list(row)) for row in zip(*map(np.asarray, leaves)))
    return [eqx.combine(jax.tree.unflatten(structure, row), rest) for row in rows]
