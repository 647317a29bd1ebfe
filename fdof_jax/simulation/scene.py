"""Scenes: a linkage, its initial state, its forces and its end time; stacks of them."""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, ParamSpec, Protocol, TypeVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from ..base.checks import instance, refusal, shown
from ..forces.element import Forces, elements_on
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage


class Scene(NamedTuple):
    """A linkage, its initial state, the forces on it and the end time.

    `simulate`, `sweep`, `joint_efforts`, `joint_reactions` and `linearize` accept a
    scene in place of its parts.

    - `linkage`, `state0`, `forces`: the arguments of `simulate`.
    - `t1`: end time [s]; a scene starts at 0.

    >>> import fdof_jax as fj
    >>> scene = fj.scenes.fig7()
    >>> scene.t1, type(scene.forces[0]).__name__
    (10.0, 'PDController')
    """

    linkage: Linkage
    state0: State
    forces: Forces
    t1: float | Array


_Stacked = TypeVar("_Stacked")
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result", covariant=True)


class OfScene(Protocol[_Arguments, _Result]):
    """A function of a linkage, forces and more, or of a scene and more."""

    @overload
    def __call__(
        self, *args: _Arguments.args, **kwargs: _Arguments.kwargs
    ) -> _Result: ...

    @overload
    def __call__(self, scene: Scene, /, *args: Any, **kwargs: Any) -> _Result: ...


def accepts_scene(
    function: Callable[_Arguments, _Result],
) -> OfScene[_Arguments, _Result]:
    """Decorates a function to accept a `Scene` in place of the scene's parts.

    The parts are the arguments `linkage`, `state0` (or `state`), `forces` and `t1`.
    Other arguments follow in their order.

    >>> import fdof_jax as fj
    >>> @fj.simulation.accepts_scene
    ... def mass(linkage, forces):
    ...     return float(linkage.mass.sum())
    >>> mass(fj.scenes.double_pendulum())  # [kg]
    2.0
    """
    parameters = inspect.signature(function).parameters.values()
    names = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    others = [name for name in names if name not in Scene._fields]

    @functools.wraps(function)
    def resolved(*args: Any, **kwargs: Any) -> _Result:
        if not args or not isinstance(args[0], Scene):
            return function(*args, **kwargs)
        scene, *more = args
        for name in Scene._fields:
            if name in kwargs:
                expected = "none beside a Scene, which has its own"
                raise refusal(name, expected, kwargs[name])
        if len(more) > len(others):
            raise ValueError(
                f"scene: expected {function.__name__}(scene, {', '.join(others)}), as "
                "a Scene has its own linkage, state and forces, got "
                f"{len(args)} positional arguments."
            )
        parts = scene._asdict() | {"state": scene.state0}
        own = {n: parts[n] for n in names if n in parts and n not in kwargs}
        return function(**own | dict(zip(others, more)), **kwargs)  # type: ignore

    return resolved


def with_full_size(scene: Scene) -> Scene:
    """Returns the scene with forces of full size."""
    return scene._replace(forces=elements_on(scene.linkage, scene.forces))


def is_number(leaf: object) -> bool:
    """Returns whether a leaf of a scene is data: an array or a float.

    Python's integers and booleans, such as an element's index, are not data.
    """
    return eqx.is_array_like(leaf) and not isinstance(leaf, bool | int)


def _as_array(leaf: ArrayLike) -> np.ndarray:
    array = np.asarray(leaf)
    floating = array.dtype.kind == "f"
    return array.astype(jnp.result_type(float)) if floating else array


def _parts(scene: PyTree) -> tuple[PyTree, PyTree]:
    if isinstance(scene, Scene):  # whose end time may be an integer
        scene = scene._replace(t1=np.asarray(scene.t1, float))
    return eqx.partition(scene, is_number)


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
    """Splits stacked scenes into their members."""
    instance(name, scenes, Scene)
    arrays, rest = eqx.partition(scenes, is_number)
    leaves, structure = jax.tree.flatten(arrays)
    sizes = {np.shape(leaf)[:1] for leaf in leaves}
    if len(sizes) != 1 or sizes <= {(), (0,)}:
        expected = "scenes stacked along a leading axis of one size (see `stacked`)"
        raise refusal(name, expected, scenes)
    rows = (jax.device_put(list(row)) for row in zip(*map(np.asarray, leaves)))
    return [eqx.combine(jax.tree.unflatten(structure, row), rest) for row in rows]
