"""Describes what a sweep keeps as the variables of a Zarr group."""

import re
from typing import Any, NamedTuple

import diffrax
import jax
import numpy as np

from ..base.checks import refusal
from ..linkage.linkage import Linkage
from ..linkage.topology import common_unit, names_and_units, rate_unit
from ..simulation.solution import OUTCOMES, Solution, outcome_numbers

_FLAGS = {
    "flag_values": [*range(len(OUTCOMES))],
    "flag_meanings": " ".join(word.replace(" ", "_") for word in OUTCOMES),
}


class Variable(NamedTuple):
    """An array over members; its shape is that of one member."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    dimensions: list[str]
    attributes: dict[str, Any]


def _is_result(leaf: Any) -> bool:
    return isinstance(leaf, diffrax.RESULTS)


def _named(kept: Any) -> dict[str, Any]:
    """Returns the arrays of what is kept by names made of their places."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(kept, is_leaf=_is_result)
    named, taken = {}, set()
    for path, leaf in leaves:
        name = re.sub(r"\W+", "_", jax.tree_util.keystr(path)).strip("_") or "value"
        if isinstance(kept, Solution):
            name = name.removeprefix("stats_")
        # Some file systems do not tell capitals from small letters.
        if name.casefold() in taken:
            raise refusal("reduce", "names that differ in letters", name)
        taken.add(name.casefold())
        named[name] = leaf
    return named


def variables_of(like: Any, linkage: Linkage) -> list[Variable]:
    """Returns the variables of a store from the shapes of what is kept of a member."""
    of_motion = isinstance(like, Solution)
    unit = common_unit(names_and_units(linkage.ef)[1])
    labels = {
        "q": {"long_name": "joint position", "units": unit},
        "qd": {"long_name": "joint velocity", "units": rate_unit(unit)},
        "num_steps": {"long_name": "number of steps", "units": "1"},
        "time_reached": {"long_name": "time reached", "units": "s"},
    }
    variables = []
    for name, leaf in _named(like).items():
        result = _is_result(leaf)
        dtype, shape = (np.dtype("int8"), ()) if result else (leaf.dtype, leaf.shape)
        if dtype.kind not in "biufc":
            raise refusal("reduce", "numbers of a type that Zarr has", dtype)
        axes = [f"{name}_{axis + 1}" for axis in range(len(shape))]
        if of_motion and name in ("q", "qd"):
            axes = ["time", "joint"]
        elif of_motion and name.startswith("own_"):
            axes[0] = "time"
        attributes = _FLAGS if result else labels.get(name, {}) if of_motion else {}
        name = "outcome" if of_motion and result else name
        variables.append(Variable(name, dtype, shape, ["member", *axes], attributes))
    return variables


def values_of(kept: Any) -> list[np.ndarray]:
    """Returns the values of the variables, with a leading axis of members."""
    return [
        outcome_numbers(leaf).astype("int8") if _is_result(leaf) else np.asarray(leaf)
        for leaf in _named(kept).values()
    ]


def coordinates(linkage: Linkage, ts: Any) -> dict[str, tuple[np.ndarray, dict]]:
    """Returns the coordinates of motions by their dimension, with attributes."""
    names, units = names_and_units(linkage.ef)
    joints = {"long_name": "joint", "names": names, "units_of_positions": units}
    return {
        "time": (np.asarray(ts), {"long_name": "time", "units": "s"}),
        "joint": (np.arange(1, 1 + len(names), dtype="int32"), joints),
    }


def metadata(
    dtype: np.dtype,
    shape: tuple[int, ...],
    chunk: tuple[int, ...],
    dimensions: list[str],
    attributes: dict[str, Any],
) -> dict[str, Any]:
    """Returns the metadata of an array in version 3 of Zarr's format.

    Members that are not solved yet are NaN, -1, 0 or true.
    """
    fill = {"f": "NaN", "c": ["NaN", "NaN"], "i": -1, "u": 0, "b": True}[dtype.kind]
    grid = {"chunk_shape": [max(1, size) for size in chunk]}
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": grid},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}],
        "fill_value": fill,
        "attributes": attributes,
        "dimension_names": dimensions,
    }
