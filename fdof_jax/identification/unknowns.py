"""Named parameters to identify: first guesses, sizes and bounds."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..base.checks import real_array, refusal, shown

# Names and shapes of parameters, in pairs: JAX would sort a dict.
Shapes = tuple[tuple[str, tuple[int, ...]], ...]


class Unknowns(NamedTuple):
    """First guess, size (the unit of steps) and bounds of all numbers, (n,) each.

    - `shapes`: the name and the shape of each parameter.
    """

    shapes: Shapes
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


def named(shapes: Shapes, numbers: Any) -> dict[str, Any]:
    """Splits all numbers (n,) into arrays by name."""
    arrays, place = {}, 0
    for name, shape in shapes:
        size = math.prod(shape)
        arrays[name] = numbers[place : place + size].reshape(shape)[()]
        place += size
    return arrays


def unknowns_of(start: Any, bounds: Any, scale: Any) -> Unknowns:
    """Checks and completes the arguments `start`, `bounds` and `scale` of `fit`."""
    if not isinstance(start, Mapping) or not start:
        raise ValueError(
            "start: expected a dict of named parameters to find, for instance "
            f"{{'mass': 2.0}}, got {shown(start)}."
        )
    for argument, given in (("bounds", bounds), ("scale", scale)):
        known = given is None or isinstance(given, Mapping) and set(given) <= set(start)
        if not known:
            names = shown(list(start))
            raise refusal(argument, f"a dict with names from {names}", given)
    shapes, columns = [], []
    for name, value in start.items():
        if not isinstance(name, str):
            raise ValueError(f"start: expected names for keys, got {shown(name)}.")
        shape = np.asarray(value, dtype=object).shape
        first = np.asarray(real_array(f"start[{shown(name)}]", value, shape))
        if name in (scale or {}):
            size = real_array(
                f"scale[{shown(name)}]", scale[name], shape, above=0, broadcast=True
            )
        elif not first.any():
            missing = f"a size for {shown(name)}, whose start is 0"
            raise refusal("scale", missing, scale)
        else:
            size = np.where(first == 0, np.abs(first).max(), np.abs(first))
        pair = (bounds or {}).get(name, (-np.inf, np.inf))
        place = f"bounds[{shown(name)}]"
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError(f"{place}: expected (least, greatest), got {shown(pair)}.")
        low, high = (
            np.asarray(
                real_array(f"{place}[{i}]", b, shape, finite=False, broadcast=True)
            )
            for i, b in enumerate(pair)
        )
        if not ((low <= first) & (first <= high)).all():
            raise ValueError(
                f"{place}: expected the start between them, got {shown(pair)} around "
                f"{shown(first.tolist())}."
            )
        shapes.append((name, shape))
        columns.append([np.ravel(array) for array in (first, size, low, high)])
    return Unknowns(tuple(shapes), *map(np.concatenate, zip(*columns)))
