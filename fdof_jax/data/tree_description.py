"""Conversion of the library's pytrees to JSON and arrays, and back without a template.

Nothing in a description is executed: classes are looked up, in the library and among
those of the caller.
"""

import dataclasses
import importlib
import inspect
import struct
import types
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.checks import is_traced, refusal, shown

_PACKAGE = "fdof_jax"
_RESULT: Any = diffrax.RESULTS.successful
_Item, _EnumerationMeta = type(_RESULT), type(diffrax.RESULTS)


class Unreadable(Exception):
    """An error that describes what is wrong with a file, without the file's name."""


# Names of classes and functions

# Classes in saved trees that are not public.
_WITHIN = {
    "DriveState": "control.drives",
    "History": "tuning.result",
    "Separation": "forces.points",
}
# Classes in files of 0.1 that are no more; their instances are loaded as dictionaries.
_REMOVED = (f"{_PACKAGE}.tuning_run:Job",)
# Fields that results in files of 0.1 lack: they get their defaults.
_ADDED = {
    f"{_PACKAGE}:FitResult": {"held_out": (), "faults": ("saved without a verdict",)},
    f"{_PACKAGE}:GradientReport": dict(switches=0, slowest_crossing=np.inf, times={}),
    f"{_PACKAGE}:SampledMotion": dict(delay=0.0, q_begin=None),
}


def _name(thing: Any) -> str:
    """The name to store: the public one, independent of the defining module."""
    name = thing.__qualname__
    if vars(diffrax).get(name) is thing:
        return f"diffrax:{name}"
    if _of_the_library(name) is thing:
        return f"{_PACKAGE}:{name}"
    return f"{thing.__module__}:{name}"


def _found(name: str) -> Any:
    """Returns what a file may name without `classes`, or None."""
    module, _, qualname = name.partition(":")
    if module == "diffrax":
        found = vars(diffrax).get(qualname)
        return found if isinstance(found, _EnumerationMeta) else None
    # Version 0.1 stored submodules.
    return _of_the_library(qualname) if module.partition(".")[0] == _PACKAGE else None


def _of_the_library(name: str) -> Any:
    """Returns the class or function of the library with the given name, or None."""
    if name in _WITHIN:
        module = importlib.import_module(f"{_PACKAGE}.{_WITHIN[name]}")
    else:
        rooms = "analysis control forces identification references simulation tuning"
        places = [_PACKAGE, *(f"{_PACKAGE}.{room}" for room in rooms.split())]
        listing = map(importlib.import_module, places)
        module = next((m for m in listing if name in m.__all__), None)
    found = getattr(module, name, None)
    return found if isinstance(found, type | types.FunctionType) else None


def _class(name: str, classes: Sequence[type]) -> Any:
    """Returns the class named `name`, of the library, diffrax or the caller."""
    found, (module, _, qualname) = _found(name), name.partition(":")
    if isinstance(found, type) and not inspect.isabstract(found):
        return found
    same = [c for c in classes if _name(c) == name]
    # The module of a class is __main__ only while the script that defines it runs.
    moved = [
        c
        for c in classes
        if c.__qualname__ == qualname and "__main__" in (module, c.__module__)
    ]
    for candidates in (same, moved):
        if len(candidates) == 1:
            return candidates[0]
    raise Unreadable(
        f"expected classes of the library or of `classes`, got {name}: import that "
        "class and pass it, as in load(path, classes=(MyElement,))"
    )


def _fields(kind: Any) -> list[str] | None:
    """Field names of a NamedTuple or dataclass, None for other classes."""
    if dataclasses.is_dataclass(kind):
        return [field.name for field in dataclasses.fields(kind)]
    names = getattr(kind, "_fields", None) if issubclass(kind, tuple) else None
    return None if names is None else list(names)


def _members(enumeration: Any) -> dict[str, int]:
    return {name: int(i._value) for name, i in enumeration._name_to_item.items()}


# From a tree to its description


def described(place: str, value: Any, arrays: list[np.ndarray]) -> Any:
    """Converts a tree to values of JSON, and appends its arrays to `arrays`."""
    kind = type(value)
    if value is None or kind in (bool, int, str):
        return value
    if kind is float:
        if np.isfinite(value):
            return value
        return {"kind": "float", "bits": struct.pack(">d", value).hex()}
    if kind in (list, tuple):
        items = [described(f"{place}[{i}]", v, arrays) for i, v in enumerate(value)]
        return items if kind is list else {"kind": "tuple", "items": items}
    if kind is dict:
        if not all(type(key) is str for key in value):
            raise refusal(place, "strings as keys", list(value)[:20])
        items = {
            k: described(f"{place}[{shown(k)}]", v, arrays) for k, v in value.items()
        }
        return {"kind": "dict", "items": items}
    if isinstance(value, Array) or kind is np.ndarray or isinstance(value, np.generic):
        return _described_array(place, value, arrays)
    if kind is _Item and isinstance(value._value, Array | np.ndarray):
        return {
            "kind": "enumeration",
            "class": _name(value._enumeration),
            "members": _members(value._enumeration),
            "value": _described_array(place, value._value, arrays),
        }
    if isinstance(value, types.FunctionType):
        if _of_the_library(value.__qualname__) is value:
            return {"kind": "function", "name": _name(value)}
        expected = "an equinox.Module with a __call__, which can be saved in place of a"
        raise refusal(place, f"{expected} function of one's own", value)
    names, stored = _fields(kind), _name(kind)
    # Classes within the library that `_found` does not know could not be loaded.
    if names is not None and not stored.startswith(f"{_PACKAGE}."):
        fields = {}
        for name in names:
            if not hasattr(value, name):
                raise ValueError(f"{place}.{name}: expected a value, got none.")
            item = getattr(value, name)
            fields[name] = described(f"{place}.{name}", item, arrays)
        return {"kind": "object", "class": stored, "fields": fields}
    raise refusal(
        place,
        "arrays, numbers, strings, or lists, tuples, dicts, NamedTuples, dataclasses "
        "and modules of such",
        value,
    )


def _described_array(place: str, value: Any, arrays: list[np.ndarray]) -> dict:
    if is_traced(value):
        raise ValueError(
            f"{place}: expected a known value, got {shown(value)}: save outside of "
            "jit, vmap and grad."
        )
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        node = {"kind": "key", "implementation": str(jax.random.key_impl(value))}
        value = jax.random.key_data(value)
    elif isinstance(value, Array):
        node = {"kind": "jax", "weak": value.weak_type}
    else:
        node = {"kind": "scalar" if isinstance(value, np.generic) else "numpy"}
    try:
        array = np.asarray(value)
    except RuntimeError as error:  # deleted, or on devices of other processes
        raise ValueError(f"{place}: expected an array at hand, got {error}.") from error
    extended = jnp.issubdtype(array.dtype, np.number)  # for instance bfloat16
    if array.dtype.kind not in "biufcmMSU" and not extended:
        raise ValueError(
            f"{place}: expected an array of numbers, got one of {array.dtype}."
        )
    arrays.append(array)
    shape = list(array.shape)
    return node | {"array": len(arrays) - 1, "dtype": array.dtype.name, "shape": shape}


# From a description to its tree


class Restorer:
    """Restores trees from descriptions, given the arrays and the caller's classes."""

    def __init__(self, array: Callable[[int], np.ndarray], classes: Sequence[type]):
        self.stored, self.classes = array, classes

    def tree(self, node: Any) -> Any:
        if isinstance(node, list):
            return [self.tree(item) for item in node]
        if not isinstance(node, dict):
            return node
        kind = node["kind"]
        if kind == "float":
            return struct.unpack(">d", bytes.fromhex(node["bits"]))[0]
        if kind == "tuple":
            return tuple(self.tree(item) for item in node["items"])
        if kind == "dict":
            return {key: self.tree(item) for key, item in node["items"].items()}
        if kind == "function":
            found = _found(node["name"])
            if not isinstance(found, types.FunctionType):
                name = node["name"]
                raise Unreadable(f"expected a function of the library, got {name}")
            return found
        if kind == "enumeration":
            return self.item(node)
        if kind == "object":
            return self.instance(node)
        return self.placed(node, self.array(node))

    def instance(self, node: dict) -> Any:
        if node["class"] in _REMOVED:
            return {name: self.tree(item) for name, item in node["fields"].items()}
        cls = _class(node["class"], self.classes)
        names, fields = _fields(cls), node["fields"]
        added = _ADDED.get(_name(cls), {})
        if names is None or set(names) != set(fields) | set(added):
            raise Unreadable(
                f"expected {node['class']} with the fields {names} that this version "
                f"of it has, got {list(fields)}"
            )
        values = {
            name: self.tree(fields[name]) if name in fields else added[name]
            for name in names
        }
        if issubclass(cls, tuple):
            return tuple.__new__(cls, values.values())
        # The constructor is bypassed, as it might compute or raise.
        made = object.__new__(cls)
        for name, value in values.items():
            object.__setattr__(made, name, value)
        return made

    def item(self, node: dict) -> Any:
        enumeration = _class(node["class"], self.classes)
        if not isinstance(enumeration, _EnumerationMeta):
            raise Unreadable(f"expected an enumeration, got {node['class']}")
        numbers = self.array(node["value"])
        names = {number: name for name, number in node["members"].items()}
        # Another version of diffrax may number its members differently.
        here, value = _members(enumeration), numbers.copy()
        for number in np.unique(numbers).tolist():
            if names[number] not in here:
                raise Unreadable(
                    f"expected a member that {node['class']} has, got {names[number]}"
                )
            value[numbers == number] = here[names[number]]
        return _Item(self.placed(node["value"], value), enumeration)

    def array(self, node: dict) -> np.ndarray:
        array = self.stored(node["array"])
        if array.dtype.kind == "V":
            # NumPy's format stores other packages' dtypes as raw bytes.
            array = array.view(jnp.dtype(node["dtype"]))
        expected = node["dtype"], node["shape"]
        got = array.dtype.name, list(array.shape)
        if got != expected:
            raise Unreadable(f"expected array {node['array']} as {expected}, got {got}")
        return array

    def placed(self, node: dict, array: np.ndarray) -> Any:
        """Converts the array to the kind of value that was saved."""
        kind = node["kind"]
        if kind == "numpy":
            return array
        if kind == "scalar":
            return array[()]
        if kind == "key":
            how = node["implementation"]
            return jax.random.wrap_key_data(jnp.asarray(array), impl=how)
        if kind != "jax":
            raise KeyError(kind)
        # Otherwise JAX would round silently.
        if jax.dtypes.canonicalize_dtype(array.dtype) != array.dtype:
            raise Unreadable(
                f"expected arrays that JAX accepts as configured, got {array.dtype}"
                ": fj.configure(x64=True) enables it"
            )
        if node["weak"]:
            # A weak type is restored, so that compiled programs are found again.
            weak = jnp.full(array.shape, array.dtype.type(0).item())
            if weak.dtype == array.dtype:
                return weak.at[...].set(array)
        return jnp.asarray(array)
