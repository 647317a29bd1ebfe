"""Problems of fitting: named unknowns, recordings, and their misfit."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .. import Scene, Solution, joint_positions, tip_position
from ..checks import check_scene, function, real_array, refusal, shown
from ..simulation import sensitivities
from ..tuning import stacked
from ..tuning.search import Evaluation, check_solution, sum_of_squares

Named = dict[str, Any]  # parameters by name, as numbers or arrays
Bounds = Mapping[str, Sequence[ArrayLike]]  # (least, greatest) by name
SceneAt = Callable[[dict[str, Array]], Scene]
Observe = Callable[[Scene, Solution], Array]

# Of the steps. A short motion tells little of a parameter: an error of 1e-7 in it may
# be one of 1e-5 in the parameter.
_TOLERANCE = 1e-9


class Unknowns(NamedTuple):
    """First guess, size and bounds of all numbers, (n,) each.

    A search's unknowns z are numbers over their sizes.
    """

    shapes: tuple[tuple[str, tuple[int, ...]], ...]  # JAX would sort a dict
    start: np.ndarray
    scale: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def labels(self) -> tuple[str, ...]:
        """The name of each number; `mass[0]` for an entry of an array."""
        return tuple(
            name + (str(list(index)) if index else "")
            for name, shape in self.shapes
            for index in np.ndindex(shape)
        )

    def named(self, numbers: Array | np.ndarray) -> Named:
        """Splits numbers (n,) into parameters by name."""
        arrays, place = {}, 0
        for name, shape in self.shapes:
            size = math.prod(shape)
            arrays[name] = numbers[place : place + size].reshape(shape)[()]
            place += size
        return arrays

    def at(self, z: Array | np.ndarray) -> Named:
        """Returns the parameters by name."""
        return self.named(self.scale * z)

    def numbers(self, z: np.ndarray) -> np.ndarray:
        """Returns all numbers, within their bounds in spite of rounding."""
        return np.clip(z * self.scale, self.low, self.high)

    def box(self, runs: int) -> Iterator[np.ndarray]:
        """Yields z at the first guess and at both bounds, (run, n) each."""
        for numbers in (self.start, self.low, self.high):
            yield np.tile(numbers / self.scale, (runs, 1))


def unknowns_of(
    start: Mapping[str, ArrayLike],
    bounds: Bounds | None,
    scale: Mapping[str, ArrayLike] | None,
) -> Unknowns:
    """Checks and completes `start`, `bounds` and `scale` of `fit`."""
    if not isinstance(start, Mapping) or not start:
        expected = "a dict of named parameters to find, for instance {'mass': 2.0}"
        raise refusal("start", expected, start)
    bounds = {} if bounds is None else bounds
    scale = {} if scale is None else scale
    for argument, given in (("bounds", bounds), ("scale", scale)):
        if not isinstance(given, Mapping) or not set(given) <= set(start):
            names = shown(list(start))
            raise refusal(argument, f"a dict with names from {names}", given)
    shapes, columns = [], []
    for name, value in start.items():
        if not isinstance(name, str):
            raise refusal("start", "names for keys", name)
        shape, label = np.asarray(value, dtype=object).shape, f"[{shown(name)}]"
        first = np.asarray(real_array(f"start{label}", value, shape))
        if name in scale:
            keywords: Any = dict(above=0, broadcast=True)
            size = real_array(f"scale{label}", scale[name], shape, **keywords)
        elif not first.any():
            expected = f"a size for {shown(name)}, whose start is 0"
            raise refusal("scale", expected, scale or None)
        else:
            size = np.where(first == 0, np.abs(first).max(), np.abs(first))
        pair, place = bounds.get(name, (-np.inf, np.inf)), f"bounds{label}"
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise refusal(place, "(least, greatest)", pair)
        keywords = dict(finite=False, broadcast=True)
        low, high = (
            np.asarray(real_array(f"{place}[{i}]", end, shape, **keywords))
            for i, end in enumerate(pair)
        )
        if not ((low <= first) & (first <= high)).all():
            raise ValueError(
                f"{place}: expected bounds around the start, {shown(first.tolist())}, "
                f"got {shown(pair)}."
            )
        shapes.append((name, shape))
        columns.append([np.ravel(array) for array in (first, size, low, high)])
    return Unknowns(tuple(shapes), *map(np.concatenate, zip(*columns)))


def link_ends(scene: Scene, solution: Solution) -> Float[Array, "time link 2"]:
    """Computes the positions of the links' ends: the next joints, and the tip.

    **Returns:** points (x, y) from the ground pivot [m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101))
    >>> fj.identification.link_ends(fj.scenes.fig5(), motion)[0].tolist()
    [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]
    """
    check_solution(scene, solution)

    def ends(q):
        tip = tip_position(scene.linkage, q)
        return jnp.concatenate([joint_positions(scene.linkage, q)[1:], tip[None]])

    return jax.vmap(ends)(solution.q)


class Problem(NamedTuple):
    """A recording with its scene; `weight` is 0 where a sample is missing."""

    scene_at: SceneAt
    observe: Observe
    unknowns: Unknowns
    ts: Array
    observed: Array
    weight: Array


def lane(z: Array, problem: Problem) -> Evaluation:
    """Evaluates a recording's weighted sum of squares and its derivatives in `z`."""
    weight, there = problem.weight, problem.weight > 0

    def residuals(scene, solution):
        seen = jnp.asarray(problem.observe(scene, solution))
        if seen.shape != problem.observed.shape:
            raise ValueError(
                "observed: expected the shape of what `observe` returns, by default "
                f"the ends of links, {seen.shape}, got {problem.observed.shape}."
            )
        misfit = jnp.where(there, seen - problem.observed, 0)
        return (weight * misfit).reshape(-1)

    scene_at = lambda z: problem.scene_at(problem.unknowns.at(z))
    found = sensitivities(scene_at, residuals, z, problem.ts, _TOLERANCE)
    unweighted = found.residuals / jnp.where(there, weight, 1).reshape(-1)
    successive = there[1:] & there[:-1]
    change = jnp.diff(found.residuals.reshape(weight.shape), axis=0)
    # What is always read as it must be, as the encoder of a fixed pair, has no noise.
    misfit = jnp.abs(unweighted.reshape(weight.shape))
    rounding = 8 * jnp.finfo(misfit.dtype).eps * jnp.abs(problem.observed)
    noisy = (misfit > rounding).any(axis=0, keepdims=True)
    return sum_of_squares(
        found,
        squares=jnp.sum(unweighted**2),
        changes=jnp.sum(jnp.where(successive, change, 0) ** 2),
        readings=jnp.sum(noisy & there),
        pairs=jnp.sum(noisy & successive),
    )


def check_times(ts: ArrayLike) -> Array:
    ts = real_array("ts", ts, (None,))
    if ts.size < 2 or not (np.diff(ts) > 0).all():
        raise refusal("ts", "increasing times, two at least", ts.tolist()[:20])
    return ts


def problems_of(
    names: tuple[str, str],
    scene_at: Any,  # SceneAt, or a sequence of these
    observed: ArrayLike,
    unknowns: Unknowns,
    ts: Array,
    observe: Observe,
    noise: ArrayLike,
) -> list[Problem]:
    """Checks a scene and its recording, or lists of both."""
    numbers = "an array of real numbers"
    try:
        readings = np.asarray(observed)
    except Exception as error:  # whatever a value's own conversion raises
        raise refusal(names[1], numbers, observed) from error
    masked = isinstance(observed, np.ma.MaskedArray)  # its mask would be lost
    if masked or readings.dtype.kind not in "iuf":
        raise refusal(names[1], numbers, observed)
    readings = readings.astype(jnp.result_type(float))
    if np.isinf(readings).any():
        raise ValueError(f"{names[1]}: expected finite readings or NaN, got infinity.")
    if not isinstance(scene_at, list | tuple):
        scene_at, readings = [scene_at], readings[None]
    elif not scene_at or readings.shape[:1] != (len(scene_at),):
        raise ValueError(
            f"{names[1]}: expected a recording for each of the scenes (one at least), "
            f"got shape {readings.shape} for {len(scene_at)}."
        )
    shape = readings.shape[1:]
    if shape[:1] != ts.shape:
        raise ValueError(
            f"{names[1]}: expected a row for each of the {ts.size} times, got shape "
            f"{shape}."
        )
    noise = np.asarray(real_array("noise", noise, None, above=0))
    try:
        weights = np.broadcast_to(1 / noise, shape)
    except ValueError:
        raise ValueError(
            "noise: expected one number, or an array that broadcasts to a recording, "
            f"{shape}, got shape {noise.shape}."
        ) from None
    function("observe", observe)
    first = jax.tree.map(jnp.asarray, unknowns.named(unknowns.start))
    for each in scene_at:
        function(names[0], each)
        try:
            scene = each(first)
        except KeyError as error:
            raise ValueError(
                f"start: expected a value for {error}, which {names[0]} may use, got "
                f"{shown(list(first))}."
            ) from error
        check_scene(f"{names[0]}(...)", scene)
    stacked(scene_at, names[0])  # raises unless all are alike
    seen = ~np.isnan(readings)
    rows = zip(scene_at, np.where(seen, readings, 0), np.where(seen, weights, 0))
    return [Problem(scene, observe, unknowns, ts, *row) for scene, *row in rows]
