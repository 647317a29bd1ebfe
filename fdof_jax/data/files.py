"""Files of JSON that hold scenes, elements and results."""

import dataclasses
import importlib
import json
import math
import os
import re
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ..base.checks import array_of, is_traced, plain, refusal, shown
from ..base.frozen import Frozen
from ..base.user_warnings import without_warning
from ..base.version import __version__
from ..base.whole_files import file_path, whole_file
from ..linkage.linkage import Linkage
from ..simulation.solution import Solution

Json = Any  # numbers, texts, and lists and dicts of such
Classes = Sequence[type]
_PACKAGE = __name__.partition(".")[0]
# Where classes are looked up. The package comes last, as it warns of names in rooms;
# the states of drives and the histories of tuning are in no room's list.
_PLACES = (
    "forces control references simulation analysis tuning identification "
    "servo.drives tuning.result".split()
)
_NOT_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
_WORDS = _PACKAGE, "value", "tuple", "dict"  # names in files that are of no class
_DEEPEST = 100  # levels of lists and objects; loading them must not exhaust the stack
_DTYPES = {"b": bool, "i": int, "u": np.uint64, "f": float}
_KNOWN = "a known value: save outside of jit, vmap and grad"
# What constructors raise for arguments of another kind. Errors of a device or of memory
# say nothing about the file.
_MEANT = ValueError, TypeError, LookupError, AttributeError, ArithmeticError


def save(path: str | os.PathLike, tree: PyTree) -> None:
    """Writes scenes, elements, results or numbers to a file of JSON, for `load`.

    The file names each object by its public name, with the arguments of its
    constructor. You can read and write it by hand:

    - An argument with a default may be absent.
    - A list that begins with a number is an array, any other a tuple. `"inf"`, `"-inf"`
      and `"nan"` are numbers.
    - A tuple that begins with a number or an array is `{"tuple": [...]}`.
    - A dictionary is `{"dict": {...}}`.
    - At the top level, `"value"` names anything that is no object.

    An existing file is replaced when the new one is complete.

    **Arguments:**

    - `path`: such as "scene.json"; no suffix is added.
    - `tree`: scenes, elements, references, results, numbers, texts, arrays, and tuples
      and dicts of these. Objects of your own classes need fields, or a method
      `arguments`, for their constructor's arguments.

    **Raises:** ValueError, with the place in the tree, for what cannot be saved: a
    function, a traced value, a `Solution` (use `to_xarray`), a network or a batch (use
    `equinox.tree_serialise_leaves`).

    >>> import fdof_jax as fj
    >>> import os, tempfile
    >>> path = os.path.join(tempfile.mkdtemp(), "damper.json")
    >>> fj.save(path, fj.JointDamper([1, 2, 3]))
    >>> open(path).read()
    '{"fdof_jax": "0.2", "JointDamper": {"coefficient": [1.0, 2.0, 3.0]}}\\n'
    >>> fj.load(path)
    JointDamper(coefficient=[1, 2, 3])
    """
    path = file_path("path", path)
    try:
        node = _node("tree", tree)
        if _depth(node) > _DEEPEST:
            raise RecursionError
    except RecursionError:
        raise ValueError(
            f"tree: expected at most {_DEEPEST} levels of lists and objects in the "
            "file, got more, or some without end."
        ) from None
    version = {_PACKAGE: ".".join(__version__.split(".")[:2])}
    text = _text(version | (node if isinstance(node, dict) else {"value": node}))
    with whole_file(path) as file:
        file.write(text.encode() + b"\n")


def load(path: str | os.PathLike, classes: Classes = ()) -> Any:
    """Loads what `save` or a person wrote to a file.

    Constructors make the objects and check their arguments. Nothing else is executed.

    **Arguments:** `path`: of the file; `classes`: a tuple of your own classes that it
    names.

    **Returns:** the tree, on the default device, with numbers equal to the last bit.
    Arrays have JAX's default dtypes. Arrays without axes become Python numbers, and
    lists tuples, unless the constructor converts them.

    **Raises:** FileNotFoundError if there is no file. ValueError, with the place in the
    file, if it is not complete JSON, comes from a newer version, or names unknown
    classes or arguments, and if a constructor raises it.
    """
    path = file_path("path", path)
    several = isinstance(classes, tuple | list)
    if not (several and all(isinstance(kind, type) for kind in classes)):
        raise refusal("classes", "a tuple of classes", classes)
    content, file = path.read_bytes(), plain(str(path))
    try:
        return _value("tree", _parsed(content), classes)
    except RecursionError:
        raise ValueError(f"{file}: expected less nesting.") from None
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _public(name: str) -> type | None:
    """Returns the library's class of that name, if its instances can be saved."""
    for place in (*_PLACES, ""):
        module = importlib.import_module(f"{_PACKAGE}.{place}".rstrip("."))
        kind = vars(module).get(name)  # `getattr` might import the pictures
        if isinstance(kind, type) and kind.__module__.startswith(f"{_PACKAGE}."):
            return kind if _is_record(kind) else None
    return None


def _is_record(kind: type) -> bool:
    fields = dataclasses.is_dataclass(kind) or hasattr(kind, "_asdict")
    return fields and not issubclass(kind, Solution)


def _is_number(node: Json) -> bool:
    return (
        isinstance(node, int | float) or isinstance(node, str) and node in _NOT_FINITE
    )


def _begins_with_number(items: Json) -> bool:
    while isinstance(items, list) and items:
        items = items[0]
    return _is_number(items)


# From the tree to JSON


def _node(place: str, value: PyTree) -> Json:
    kind = type(value)
    if value is None or kind is bool or kind is str and value not in _NOT_FINITE:
        return value
    if kind is int:
        if not -(2**63) <= value < 2**64:
            raise refusal(place, "a whole number of at most 64 bits", value)
        return value
    if kind in (list, tuple):
        items = [_node(f"{place}[{i}]", item) for i, item in enumerate(value)]
        return {"tuple": items} if _begins_with_number(items) else items
    if kind is dict and all(isinstance(key, str) for key in value):
        items = {k: _node(f"{place}[{shown(k)}]", v) for k, v in value.items()}
        return {"dict": items}
    if kind is float or isinstance(value, jax.Array | np.ndarray | np.generic):
        return _numbers(place, value)
    if isinstance(value, Solution):
        expected = "no motion (to_xarray makes a Dataset, whose to_netcdf saves it)"
        raise refusal(place, expected, value)
    if not _is_record(kind):
        expected = "numbers, arrays, texts, tuples, dicts with text keys, or objects"
        if callable(value):
            expected += "; an equinox.Module with a __call__ in place of a function"
        raise refusal(place, expected, value)
    return _object(place, value)


def _numbers(place: str, value: object) -> Json:
    if is_traced(value):
        raise refusal(place, _KNOWN, value)
    try:
        array = np.asarray(array_of(value))
    except (RuntimeError, TypeError) as error:  # deleted, masked, or random keys
        raise refusal(place, "real numbers", error) from error
    if jnp.issubdtype(array.dtype, jnp.floating):  # also bfloat16
        array = array.astype(float)
    if array.dtype.kind not in _DTYPES or not array.size:
        raise refusal(place, "real numbers, at least one", value)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        finite = np.isfinite(array)
        array = np.where(finite, array.astype(object), array.astype(str))
    return array.tolist()


def _object(place: str, value: Any) -> dict[str, Json]:
    kind, name = type(value), type(value).__name__
    public = _public(name)
    ours = public or name in _WORDS or kind.__module__.startswith(f"{_PACKAGE}.")
    if public is not kind and ours:
        expected = "an object of a public class, or of your own class of another name"
        raise refusal(place, expected, kind)
    if isinstance(value, tuple):
        arguments = value._asdict()  # pyright: ignore[reportAttributeAccessIssue]
    else:
        for keys, leaf in jax.tree_util.tree_leaves_with_path(value):
            if is_traced(leaf):
                raise refusal(f"{place}{jax.tree_util.keystr(keys)}", _KNOWN, leaf)
        try:
            arguments = getattr(kind, "arguments", Frozen.arguments)(value)
            with without_warning(""):  # which came when it was made
                kind(**arguments)  # as `load` does
        except _MEANT as error:
            expected = f"a {name} that its constructor reproduces"
            other = "equinox.tree_serialise_leaves writes networks and batches"
            problem = f"{expected} ({other}); {plain(str(error))}"
            raise ValueError(f"{place}: expected {problem}") from error
    if isinstance(value, Linkage):
        arguments["topology"] = value.topology
    return {name: {k: _node(f"{place}.{k}", v) for k, v in arguments.items()}}


def _depth(node: Json) -> int:
    if not isinstance(node, dict | list):
        return 0
    inner = node.values() if isinstance(node, dict) else node
    return 1 + max(map(_depth, inner), default=0)


def _text(node: Json, indent: str = "", before: str = "") -> str:
    """Returns JSON that breaks only lines that are too long."""
    line = before + json.dumps(node)
    if len(indent + line) < 88 or not isinstance(node, dict | list):
        return line
    inner = f"{indent}  "
    if isinstance(node, dict):
        rows = [_text(v, inner, f"{json.dumps(k)}: ") for k, v in node.items()]
    else:
        rows = [_text(item, inner) for item in node]
    body, first = f",\n{inner}".join(rows), line[len(before)]
    return f"{before}{first}\n{inner}{body}\n{indent}{line[-1]}"


# From JSON to the tree


def _parsed(content: bytes) -> Json:
    try:
        file = json.loads(
            content.decode("utf-8-sig"), object_pairs_hook=_unique,
            parse_float=_finite, parse_constant=_finite,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"expected JSON, got {plain(str(error))}.") from None
    version = file.pop(_PACKAGE, None) if isinstance(file, dict) else None
    parts = re.match(r"(\d{1,9})\.(\d{1,9})", version if type(version) is str else "")
    if parts is None:
        raise refusal(f'"{_PACKAGE}"', 'the version of the library, as "0.2"', version)
    if [*map(int, parts.groups())] > [*map(int, __version__.split(".")[:2])]:
        raise refusal(f'"{_PACKAGE}"', f"{__version__} or an older version", version)
    return file["value"] if [*file] == ["value"] else file


def _unique(pairs: list[tuple[str, Json]]) -> dict[str, Json]:
    members = dict(pairs)
    if len(members) < len(pairs):
        names = shown([name for name, _ in pairs])
        raise ValueError(f"a name twice in one object, of {names}")
    return members


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f'{plain(text)}, which is no number ("inf" and "nan" are)')
    return value


def _value(place: str, node: Json, classes: Classes) -> PyTree:
    at = lambda step, inner: _value(f"{place}{step}", inner, classes)
    if isinstance(node, list):
        if _begins_with_number(node):
            return _array(place, node)
        return tuple(at(f"[{i}]", item) for i, item in enumerate(node))
    if isinstance(node, str):
        return _NOT_FINITE.get(node, node)
    if not isinstance(node, dict):
        return node
    if len(node) != 1:
        raise refusal(place, "an object by its name alone", list(node)[:20])
    [(name, inner)] = node.items()
    if name == "tuple" and isinstance(inner, list):
        return tuple(at(f"[{i}]", item) for i, item in enumerate(inner))
    if not isinstance(inner, dict):
        raise refusal(f"{place}.{plain(name)}", "named arguments", inner)
    if name == "dict":
        return {key: at(f"[{shown(key)}]", item) for key, item in inner.items()}
    own = {kind for kind in classes if kind.__name__ == name}
    maker = _public(name) or (own.pop() if len(own) == 1 else None)
    if maker is None:
        expected = "a class of fdof_jax, or one of load(path, classes=(MyElement,))"
        raise refusal(place, expected, name)
    arguments = {key: at(f".{plain(key)}", item) for key, item in inner.items()}
    try:
        return maker(**arguments)
    except ValueError as error:
        names_argument = re.match(r"[a-z]\w*[:,.[]", str(error))
        raise ValueError(f"{place}{'.' if names_argument else ': '}{error}") from error
    except _MEANT as error:
        problem = f"the arguments of {name}, got {plain(str(error))}"
        raise ValueError(f"{place}: expected {problem}.") from error


def _array(place: str, node: list[Json]) -> jax.Array:
    try:
        numbers = _floats(node)
        array = np.asarray(numbers)
        # NumPy makes floats of whole numbers that no type of 64 bits has in common.
        if array.dtype.kind == "f":
            large = np.asarray(numbers, object)[np.abs(array) >= 2**63]
            if any(isinstance(number, int) for number in large):
                raise ValueError
        dtype = jnp.result_type(_DTYPES[array.dtype.kind])
        return jax.device_put(np.asarray(numbers, dtype))
    except (ValueError, LookupError, OverflowError):
        expected = "numbers in lists of one length, whole ones of 64 bits at most"
        raise refusal(place, expected, node) from None


def _floats(node: Json) -> Json:
    """Returns nested lists of numbers, with floats in place of their names."""
    if isinstance(node, list):
        return [_floats(item) for item in node]
    if not _is_number(node):  # NumPy would reserve the longest text for each number
        raise ValueError
    return _NOT_FINITE.get(node, node)
