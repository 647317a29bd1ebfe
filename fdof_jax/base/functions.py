"""Plain functions as data, so that functions of equal code share compiled programs."""

import builtins
import dis
import functools
import inspect
import types
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .checks import function as checked
from .configuration import options_of_loops
from .user_warnings import warn

# JAX knows a function by its identity: each `lambda` of a loop would need a program of
# its own. Here a function is its code and the values that it reaches. Numbers among
# these are arrays, of which new values need no new program. A function that reaches
# what may change unseen, such as a user's object or module, stays as it is.

# Packages whose functions, classes and constants do not change.
_FIXED = {
    "builtins", "cmath", "diffrax", "equinox", "fdof_jax", "functools", "itertools",
    "jax", "jaxlib", "math", "numpy", "operator", "optimistix", "scipy",
}  # fmt: skip
_CONSTANTS = bool | int | str | bytes | np.dtype | np.ufunc | jnp.ufunc
_AS_IT_IS = _CONSTANTS | jax.Array | type(jax.jit(lambda: None))
_OF_NUMPY = {"pi", "inf", "nan", "e", "newaxis"}
_OPAQUE = {
    # What these do depends on more than the names in the code.
    "eval", "exec", "globals", "locals", "vars", "super",
    "STORE_GLOBAL", "DELETE_GLOBAL", "IMPORT_NAME",
    # These, text made of values and what catches errors tell a number from an array.
    "format", "getattr", "hasattr", "isinstance", "repr", "str", "type", "MATCH_CLASS",
    "FORMAT_VALUE", "FORMAT_SIMPLE", "FORMAT_WITH_SPEC", "PUSH_EXC_INFO",
}  # fmt: skip

# Kinds of numbers that are data. Code that uses them in Python, as lengths or where it
# decides, is known by fewer of them, at last by none.
_DATA = (float, np.floating, int), (float, np.floating)
_fewer: Counter["_Code"] = Counter()

_T = TypeVar("_T")
_Function = TypeVar("_Function", bound=Callable)


@dataclass(frozen=True)
class _Code:
    """A function's code, equal to the same code elsewhere in the source."""

    code: types.CodeType = field(compare=False)
    anywhere: types.CodeType


@functools.lru_cache(maxsize=1024)
def _anywhere(code: types.CodeType) -> types.CodeType:
    """Returns code without its line numbers, which only messages need."""
    within = lambda x: _anywhere(x) if isinstance(x, types.CodeType) else x
    constants = tuple(map(within, code.co_consts))
    return code.replace(co_firstlineno=1, co_linetable=b"", co_consts=constants)


def _code_of(function: types.FunctionType) -> _Code:
    return _Code(function.__code__, _anywhere(function.__code__))


class SharedFunction(eqx.Module):
    """A function in parts: its code, and the values that it reaches."""

    reach: Any  # values of the closure, defaults, keyword defaults, global names
    code: _Code = eqx.field(static=True)

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        closure, defaults, of_keywords, names = self.reach
        cells = tuple(map(types.CellType, closure))
        within = names | {"__builtins__": builtins}
        function = types.FunctionType(self.code.code, within, None, defaults, cells)
        function.__kwdefaults__ = of_keywords
        before, structure = jax.tree.flatten(self.reach)
        returned = function(*arguments, **keywords)
        closure = tuple(cell.cell_contents for cell in cells)
        after, now = jax.tree.flatten((closure, defaults, of_keywords, names))
        if now != structure or any(a is not b for a, b in zip(after, before)):
            raise TypeError("it changes a value outside, here a copy")
        return returned


def jit(function: _Function) -> _Function:
    """Decorates a function to run as one compiled program, as `tune` and `fit` do.

    It is `equinox.filter_jit` that knows plain functions among the arguments by their
    code; numbers that they reach are data. Other functions of equal code, such as a
    `lambda` made anew in a loop, then need no program of their own, which takes
    seconds to compile. JAX's transformations belong inside.

    **Raises:** ValueError unless `function` is callable. Calls warn of the third
    similar function that needs its own program.
    """
    checked("function", function)
    program = eqx.filter_jit(
        function,
        compiler_options=options_of_loops(),  # pyright: ignore[reportCallIssue]
    )
    signature = inspect.signature(function)

    @functools.wraps(program)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)

        def run(*values: PyTree) -> Any:
            bound.arguments = dict(zip(bound.arguments, values))
            return program(*bound.args, **bound.kwargs)

        return sharing_functions(run, **bound.arguments)

    return call  # type: ignore[return-value]


def sharing_functions(run: Callable[..., _T], /, **trees: PyTree) -> _T:
    """Returns `run(*trees)`, with plain functions in the trees in their shared form.

    The third similar callable that needs its own program brings a warning.
    """
    if not any(map(callable, jax.tree.leaves(trees))):
        return run(*trees.values())
    while True:
        # Of a dict, JAX would return the values in the order of its keys.
        shared = {name: jax.tree.map(_shared, tree) for name, tree in trees.items()}
        try:
            result = run(*shared.values())
            break
        except (TypeError, ValueError, AttributeError, IndexError):
            nodes = jax.tree.leaves(shared, is_leaf=_is_shared)
            codes = {node.code for node in nodes if _is_shared(node)}
            if not codes:
                raise
            _fewer.update(codes)
    _warn_of_third(shared)
    return result


def _is_shared(node: object) -> bool:
    return isinstance(node, SharedFunction)


def _shared(leaf: object) -> object:
    """Returns a plain function in its shared form if possible, else the leaf itself."""
    if not inspect.isfunction(leaf) or leaf.__closure__ is None and _is_fixed(leaf):
        return leaf
    try:
        return _parts_of(leaf)
    # Also an empty cell, keys without an order, or an integer of more than 64 bits.
    except (TypeError, ValueError, OverflowError):
        return leaf


def _parts_of(
    function: types.FunctionType, within: tuple[types.FunctionType, ...] = ()
) -> SharedFunction:
    """Returns a function in its shared form, or raises an error that says why not."""
    code, among = _code_of(function), function.__globals__
    if function.__dict__ or function in within or _fewer[code] >= len(_DATA):
        raise TypeError("it has attributes, calls itself, or uses numbers in Python")
    read = _global_names(code.code)
    names = {name: among[name] for name in sorted(read) if name in among}
    # NumPy's functions may take an array for no number, or draw random ones.
    if any(value is np for value in names.values()):
        if not set(code.code.co_names) <= {*names, *_OF_NUMPY}:
            raise TypeError("it calls NumPy")
    closure = tuple(cell.cell_contents for cell in function.__closure__ or ())
    of_keywords = dict(sorted((function.__kwdefaults__ or {}).items()))
    numbers, within = _DATA[_fewer[code]], (*within, function)

    def part(leaf: object) -> object:
        if isinstance(leaf, numbers) and not isinstance(leaf, bool):
            # Of Python's numbers an array that leaves the types of others, too.
            return jax.device_put(leaf)
        array = type(leaf) is np.ndarray
        if array or isinstance(leaf, _AS_IT_IS) or _is_fixed(leaf):
            return leaf
        if inspect.isfunction(leaf):
            return _parts_of(leaf, within)
        raise TypeError("it reaches what may change unseen")

    reach = closure, function.__defaults__, of_keywords, names
    return SharedFunction(jax.tree.map(part, reach, is_leaf=_out_of_order), code)


def _out_of_order(node: object) -> bool:
    """Returns whether a node is a dict whose keys are not sorted, as JAX's are."""
    return isinstance(node, dict) and list(node) != sorted(node)


@functools.lru_cache(maxsize=1024)
def _global_names(code: types.CodeType) -> frozenset[str]:
    """Returns the global names that code reads, or raises TypeError."""
    steps = [(step.opname, step.argval) for step in dis.get_instructions(code)]
    names = {name for step, name in steps if step in ("LOAD_GLOBAL", "LOAD_NAME")}
    if not _OPAQUE.isdisjoint(names.union(step for step, _ in steps)):
        raise TypeError("it may write such names, or tell a number from an array")
    inner = [x for x in code.co_consts if isinstance(x, types.CodeType)]
    return frozenset(names.union(*map(_global_names, inner)))


def _is_fixed(value: object) -> bool:
    """Returns whether a value is a known package's module, function or class."""
    name = value.__name__ if inspect.ismodule(value) else None
    if isinstance(value, types.FunctionType | types.BuiltinFunctionType | type):
        name = value.__module__  # None of a builtin that is bound to an object
    return name is not None and name.partition(".")[0] in _FIXED


# Of callables that have programs of their own, by their code or type.
_alike: defaultdict[_Code | type, set[int]] = defaultdict(set)


def _warn_of_third(trees: dict[str, PyTree]) -> None:
    leaves, _ = jax.tree_util.tree_flatten_with_path(trees, is_leaf=_is_shared)
    for (tree, *path), leaf in leaves:
        if not callable(leaf) or isinstance(leaf, _CONSTANTS):
            continue
        inner = inspect.unwrap(leaf)
        code = _code_of(inner) if inspect.isfunction(inner) else None
        if isinstance(leaf, SharedFunction):
            code = leaf.code
        # JAX keeps a callable and so its hash, which by default is its address.
        parts, structure = jax.tree.flatten(leaf)
        key = hash((structure, *(x for x in parts if not eqx.is_array(x))))
        alike = _alike[code or type(leaf)]
        if key not in alike and len(alike) == 2:
            place = tree.key + jax.tree_util.keystr(tuple(path[:1]))
            name = code.code.co_qualname if code else type(leaf).__qualname__
            warn(
                f"{place}: expected the same function at each call, got a third one "
                f"like {name}; each compiles a program of its own, in seconds and "
                "tens of megabytes. Define the function once, outside of loops, or as "
                "an Equinox module (an Element), whose arrays are data."
            )
        alike.add(key)
