"""Scenes, and functions that accept them."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple, ParamSpec, Protocol, TypeVar, overload

from jax import Array

from ..base.checks import refusal
from ..forces.element import Forces
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage


class Scene(NamedTuple):
    """A linkage, its initial state, the forces on it and the end time.

    `simulate`, `sweep`, `joint_efforts`, `joint_reactions` and `linearize` accept a
    scene in place of its parts.

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


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result", covariant=True)


class OfScene(Protocol[_Arguments, _Result]):
    """A function that accepts a scene in place of its parts."""

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
