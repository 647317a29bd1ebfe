"""Named parameters to identify: first guesses, sizes and bounds."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..checks import real_array


def flat(arrays: Iterable[Any]) -> np.ndarray:
    """All numbers of the arrays in one row."""
    return np.concatenate([np.ravel(a) for a in arrays])


class Unknowns(NamedTuple):
    """First guess, size (the unit of steps) and bounds of each named parameter."""

    names: tuple[str, ...]
    start: tuple[np.ndarray, ...]
    scale: tuple[np.ndarray, ...]
    low: tuple[np.ndarray, ...]
    high: tuple[np.ndarray, ...]

    @property
    def flat_start(self) -> np.ndarray:
        return flat(self.start)

    @property
    def flat_scale(self) -> np.ndarray:
        return flat(self.scale)

    @property
    def flat_low(self) -> np.ndarray:
        return flat(self.low)

    @property
    def flat_high(self) -> np.ndarray:
        return flat(self.high)

    @property
    def labels(self) -> tuple[str, ...]:
        """The name of each number; `mass[0]` for an entry of an array."""
        return tuple(
            name + (str(list(index)) if index else "")
            for name, value in zip(self.names, self.start)
            for index in np.ndindex(value.shape)
        )

    def named(self, flat: np.ndarray) -> dict[str, Any]:
        """Arrays by name from all numbers in one row."""
        parts = np.split(flat, np.cumsum([value.size for value in self.start])[:-1])
        return {
            name: part.reshape(value.shape)[()]
            for name, part, value in zip(self.names, parts, self.start)
        }


def _named(name: str, value: Any, start: Mapping[str, Any]) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping) or set(value) - set(start):
        raise ValueError(
            f"{name}: expected a dict with names from {list(start)}, got {value!r}."
        )
    return dict(value)


def unknowns_of(start: Any, bounds: Any, scale: Any) -> Unknowns:
    """Checks and completes the arguments `start`, `bounds` and `scale` of `fit`."""
    if not isinstance(start, Mapping) or not start:
        raise ValueError(
            "start: expected a dict of named parameters to find, for instance "
            f"{{'mass': 2.0}}, got {start!r}."
        )
    bounds, scale = _named("bounds", bounds, start), _named("scale", scale, start)
    columns: list[tuple[np.ndarray, ...]] = []
    for name, value in start.items():
        if not isinstance(name, str):
            raise ValueError(f"start: expected names for keys, got {name!r}.")
        shape = np.asarray(value, dtype=object).shape
        first = np.asarray(real_array(f"start[{name!r}]", value, shape))
        if name in scale:
            size = real_array(
                f"scale[{name!r}]", scale[name], shape, above=0, broadcast=True
            )
        elif not first.any():
            raise ValueError(
                f"scale: expected a size for {name!r}, whose start is 0, got {scale!r}."
            )
        else:
            size = np.where(first == 0, np.abs(first).max(), np.abs(first))
        pair = bounds.get(name, (-np.inf, np.inf))
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ValueError(
                f"bounds[{name!r}]: expected (least, greatest), got {pair!r}."
            )
        low, high = (
            np.asarray(
                real_array(
                    f"bounds[{name!r}][{i}]", b, shape, finite=False, broadcast=True
                )
            )
            for i, b in enumerate(pair)
        )
        if not ((low <= first) & (first <= high)).all():
            raise ValueError(
                f"bounds[{name!r}]: expected the start between them, got {pair!r} "
                f"around {first.tolist()}."
            )
        columns.append((first, np.asarray(size), low, high))
    first, size, low, high = zip(*columns)
    return Unknowns(tuple(start), first, size, low, high)
