"""Checks of the arguments of public functions.

Shapes and types are always checked, values only while JAX does not trace them.
"""

import importlib
import itertools
import operator
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer, eval_context
from jaxtyping import PyTree
from numpy.typing import ArrayLike

try:
    from jax.extend.core import get_opaque_trace_state
except ImportError:  # before JAX 0.10
    from jax.core import get_opaque_trace_state  # pyright: ignore

from .user_warnings import warn

# In a shape: any number of joints, which is compared with the arm's where both meet.
JOINT = "joint"


def is_traced(*trees: PyTree) -> bool:
    """Returns whether a JAX transformation traces any leaf of `trees`.

    >>> import fdof_jax as fj
    >>> fj.checks.is_traced(fj.scenes.fig5())
    False
    """
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def transformation() -> object:
    """Returns a value that identifies the running JAX transformation."""
    return get_opaque_trace_state(convention="nnx")


def is_transformed() -> bool:
    """Returns whether a JAX transformation is running, whatever it traces."""
    # Closures may hold traced values, which no check can find.
    with eval_context():
        outside = transformation()
    return transformation() != outside


def known(*trees: PyTree) -> bool:
    """Returns whether all leaves are concrete numbers."""
    numbers = all(map(eqx.is_array_like, jax.tree.leaves(trees)))
    return numbers and not is_traced(*trees)


def check_known(name: str, *trees: PyTree) -> None:
    """Raises ValueError if a JAX transformation traces any leaf of `trees`."""
    if is_traced(*trees):
        raise ValueError(
            f"{name}: expected known values, outside of JAX's transformations."
        )


def concrete(value: ArrayLike) -> np.ndarray | None:
    """Returns `value` as a NumPy array, or None while it is traced."""
    return None if is_traced(value) else np.asarray(value)


_MOST_SHOWN = 200  # characters of a message that repeat what was given


def plain(text: str) -> str:
    """Returns a text on one line, without control codes, cut if it is long."""
    text = " ".join(text.split())
    if len(text) > _MOST_SHOWN:
        text = f"{text[: _MOST_SHOWN - 3]}..."
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in text
    )


def shown(value: object) -> str:
    """Returns the text of a value for messages; if that fails, its type."""
    try:
        return plain(repr(_beginning(value)))
    except Exception:  # whatever a value's own text raises, as a deleted array's does
        return f"a value of type {plain(type(value).__name__)}"


def _beginning(value: Any) -> Any:
    """Returns the beginning of a value: the text of a million numbers is slow."""
    if isinstance(value, tuple):  # also a NamedTuple
        return tuple.__new__(type(value), map(_beginning, value[:_MOST_SHOWN]))
    if type(value) is list:
        return [*map(_beginning, value[:_MOST_SHOWN])]
    if type(value) is dict:
        items = itertools.islice(value.items(), _MOST_SHOWN)
        return {key: _beginning(item) for key, item in items}
    return value[:_MOST_SHOWN] if type(value) in (str, bytes) else value


def refusal(name: str, expected: str, got: object) -> ValueError:
    """Returns the error to raise for a malformed argument."""
    return ValueError(f"{name}: expected {expected}, got {shown(got)}.")


def array_of(value: Any) -> Array | np.ndarray:
    """Returns a value as an array of NumPy, or of JAX if it is traced.

    Raises TypeError for a masked array, whose mask would be lost.
    """
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError("masked arrays are not supported")
    return jnp.asarray(value) if is_traced(value) else np.asarray(value)


def real_numbers(
    name: str,
    value: object,
    shape: tuple[int | str | None, ...] | None,
    *,
    minimum: float | None = None,
    above: float | None = None,
    finite: bool = True,
    broadcast: bool = False,
    rows: int | None = None,
    unit: str = "",
    of: str = "",
) -> Array | np.ndarray:
    """Returns numbers as `real_array` does, but as a new array of NumPy.

    Traced values, and an array of JAX that fits already, stay in JAX. JOINT in `shape`
    stands for any number of joints. So many `rows` of it are accepted too.
    """

    def refuse(got: str) -> ValueError:
        expected = "an array of real numbers"
        if shape is not None:
            size = "x".join("n" if n in (None, JOINT) else str(n) for n in shape)
            expected = f"an array of {size} real numbers" if shape else "a real number"
        if of:
            expected += f" for {of}"
        if finite:
            expected += ", finite" if shape == () else ", all finite"
        if minimum is not None:
            expected += f", at least {minimum:g}"
        if above is not None:
            expected += f", above {above:g}"
        if unit:
            expected += f" [{unit}]"
        if broadcast and shape:
            more = f", or {rows} such rows" if rows else ""
            expected += f" (or one number for all{more})"
        return ValueError(f"{name}: expected {expected}, got {got}.")

    traced = is_traced(value)
    try:
        array = array_of(value)
    except Exception as error:  # whatever a value's own conversion raises
        raise refuse(shown(value)) from error
    if array.dtype.kind not in "iuf":
        raise refuse(shown(value))
    sizes = shape_in_rows(array, rows)
    shape = sizes if shape is None else shape
    fits = len(sizes) == len(shape) and all(
        want in (None, JOINT, have) for want, have in zip(shape, sizes)
    )
    if not fits and not (broadcast and array.ndim == 0):
        raise refuse(f"shape {array.shape}" if array.ndim else shown(value))
    if not traced:
        kept = np.array(array, dtype=jnp.result_type(float))
        if not within_bounds(kept, minimum=minimum, above=above, finite=finite):
            text = plain(np.array2string(np.asarray(array), threshold=20))
            raise refuse(text.removesuffix("."))  # 1.0 is shown as "1."
        if unit == "rad":
            radians(name, kept)
        if (
            isinstance(value, Array)
            and value.dtype == kept.dtype
            and fits
            and not value.weak_type
        ):
            return value
        array = kept
    if not fits and JOINT not in shape:
        array = (jnp if traced else np).broadcast_to(array, shape)  # type: ignore[arg-type]
    return jnp.asarray(array, dtype=float) if traced else array


def shape_in_rows(value: Any, rows: int | None) -> tuple[int, ...]:
    """Returns the shape of an array, or of each of its `rows` if it has so many."""
    shape = np.shape(value)
    return shape[1:] if len(shape) == 2 and shape[0] == rows else shape


def within_bounds(
    values: Any, minimum: float | None, above: float | None, finite: bool, **_: Any
) -> Array:
    """Returns whether numbers, known or traced, are within bounds."""
    holds = abs(values) < np.inf if finite else values == values
    if minimum is not None:
        holds = holds & (values >= minimum)
    if above is not None:
        holds = holds & (values > above)
    return holds.all()


def real_array(
    name: str, value: object, shape: tuple[int | str | None, ...] | None, **rules: Any
) -> Array:
    """Returns `value` as an array of JAX of the default float dtype.

    **Arguments:** `name`: the argument's name, for messages; `shape`: None means any
    shape, and within a shape any length; `minimum`, `above`: lower bounds, inclusive
    and exclusive; `finite=False` accepts infinities; `broadcast=True` repeats one
    number for all entries; `unit`, such as "m", and `of`, what the numbers belong to,
    are for messages.

    **Raises:** ValueError for a wrong shape or type, NaN, and numbers out of bounds. Of
    traced numbers only shape and type are checked. Warns of known angles in "rad" that
    look like degrees.
    """
    numbers = real_numbers(name, value, shape, **rules)
    if isinstance(numbers, Array):
        return numbers
    return jnp.asarray(numbers, dtype=float)  # else JAX 0.12 compiles for each shape


def radians(name: str, angles: np.ndarray) -> None:
    """Warns of angles that were probably meant in degrees: 30, 45, 60, ... 360."""
    size = np.where(np.abs(angles) <= 360, np.abs(angles), 0)  # not infinite
    found = angles[(size >= 30) & (size % 15 == 0)]
    if found.size:
        warn(
            f"{name}: expected angles in radians, got {found[0]:g}, which looks like "
            "degrees; numpy.deg2rad converts them."
        )


def single_precision(name: str, tree: PyTree) -> None:
    """Warns of arrays in single precision while JAX has double precision."""
    arrays = filter(eqx.is_array, jax.tree.leaves(tree))
    short = any(leaf.dtype == jnp.float32 for leaf in arrays)
    if short and jnp.result_type(float) == jnp.float64:
        warn(
            f"{name}: expected numbers in double precision, got some in float32, made "
            "before fdof_jax.configure(x64=True); build it again."
        )


def increasing(name: str, times: Array | np.ndarray) -> None:
    """Raises ValueError if there are no times, or if known ones do not increase."""
    if times.size == 0:
        raise ValueError(f"{name}: expected increasing times, at least one, got none.")
    values = concrete(times)
    if values is not None and not (np.diff(values) > 0).all():
        raise refusal(name, "increasing times", values.tolist()[:20])


def place_of(item: object, items: Sequence[object]) -> int:
    """Returns the index of the object `item` itself; arrays need not compare equal."""
    return [other is item for other in items].index(True)


def function(name: str, value: object, expected: str = "a callable") -> Callable:
    """Returns `value` if it is callable and no class, or raises ValueError."""
    if callable(value) and not isinstance(value, type):
        return value
    raise refusal(name, expected, value)


def hashable(name: str, functions: PyTree) -> None:
    """Raises ValueError if a leaf other than an array has no hash."""
    for leaf in jax.tree.leaves(functions):
        if eqx.is_array_like(leaf):
            continue
        try:
            hash(leaf)
        except TypeError:
            expected = "hashable values, as keys of compiled programs"
            raise refusal(name, expected, leaf) from None


def instance(name: str, value: object, kind: type) -> None:
    """Raises ValueError unless `value` is an instance of `kind`."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIO" else "a"
        raise refusal(name, f"{article} {kind.__name__}", value)


def whole_number(name: str, value: Any, minimum: int, most: int | None = None) -> int:
    """Returns an integer from `minimum` to `most`, also from an array without axes.

    **Raises:** ValueError for all else, bools too.
    """
    try:
        number = None if isinstance(value, bool | np.bool_) else operator.index(value)
    except Exception:  # whatever a value's own conversion raises
        number = None
    if number is None or number < minimum or (most is not None and number > most):
        upper = "" if most is None else f" and at most {most:,}"
        raise refusal(name, f"a whole number of at least {minimum}{upper}", value)
    return number


def one_of(name: str, value: object, options: Sequence[Any]) -> Any:
    """Returns `value` if it is one of `options`, no bool; else raises ValueError."""
    plain_value = isinstance(value, str | int | float | np.number)
    if plain_value and not isinstance(value, bool) and value in options:
        return options[options.index(value)]
    raise refusal(name, f"one of {tuple(options)}", value)


def optional_package(name: str, extra: str) -> ModuleType:
    """Returns the package, or raises ImportError that names the extra to install."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{name} is not installed: pip install 'fdof_jax[{extra}]' installs it."
        ) from error
