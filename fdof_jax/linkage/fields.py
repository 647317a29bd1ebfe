"""The base of elements, references, paths and timings: declared values and conditions.

`simulate` checks them again, as `equinox.tree_at` bypasses constructors.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sized
from functools import reduce
from operator import and_
from typing import Any, NamedTuple, TypeVar, dataclass_transform

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..base.checks import (
    JOINT,
    concrete,
    function,
    instance,
    is_traced,
    plain,
    real_array,
    shape_in_rows,
    within_bounds,
)
from ..base.frozen import Frozen
from ..base.known_values import in_numpy
from .linkage import Linkage, joints_of, short
from .topology import check_angles

Rules = dict[str, Any]  # of a declared array: keywords of `real_array`
Truth = Array | np.ndarray | np.bool_ | bool  # also of traced values
_Part = TypeVar("_Part", bound="Part")


class Values:
    """The type of a declared array; constructors accept any numbers for it."""

    def __get__(self, part: object, owner: type | None = None) -> Array: ...
    def __set__(self, part: object, value: ArrayLike) -> None: ...


def field(
    shape: tuple[int | str | None, ...] | None = None,
    *,
    unit: str,
    minimum: float | None = None,
    above: float | None = None,
    finite: bool = True,
    function: bool = False,
    optional: bool = False,
    rows: int | None = None,
    default: Any = dataclasses.MISSING,
    kw_only: bool = False,
) -> Any:
    """Declares an array of real numbers as a field of an element or a reference.

    Constructors and `simulate` raise ValueError for values out of bounds. If they are
    traced, the motion ends as not finite.

    **Arguments:**

    - `shape`: by default one number per joint, or one for all. In a shape, None stands
      for any length, "joint" for the number of joints.
    - `unit`: for messages, such as "N m s/rad".
    - `minimum`, `above`: lower bounds, inclusive and exclusive; `finite`: whether
      infinities are rejected.
    - `function`: whether a function that returns such an array is accepted; `optional`:
      whether None is. A default of None always is.
    - `rows`: so many rows, each like `shape`, are accepted as well.
    - `default`, `kw_only`: as in `dataclasses.field`.
    """
    per_joint = shape is None
    rules = dict(shape=(JOINT,) if per_joint else shape, broadcast=per_joint, unit=unit)
    rules |= dict(minimum=minimum, above=above, finite=finite, rows=rows)
    optional = optional or default is None
    about = {"rules": rules, "function": function, "optional": optional}
    return dataclasses.field(default=default, kw_only=kw_only, metadata=about)


def called(expected: str) -> Any:
    """Declares a field that is called, such as a reference or another element.

    **Arguments:** `expected`: describes it in messages.

    **Raises:** the constructor raises ValueError for what is not callable.

    >>> import fdof_jax as fj
    >>> class Half(fj.Element):
    ...     of: object = fj.forces.called("a force element")
    ...     def __call__(self, t, q, qd, linkage):
    ...         with fj.forces.naming("of"):
    ...             return fj.forces.element_of(self.of)(t, q, qd, linkage) / 2
    >>> arm, start, *_ = fj.scenes.double_pendulum()
    >>> Half(fj.JointEffort([4.0, 2.0]))(0.0, *start, arm).tolist()
    [2.0, 1.0]
    """
    return dataclasses.field(metadata={"called": expected})


def of_kind(kind: type, default: Any = dataclasses.MISSING) -> Any:
    """Declares a field that is an instance of a class, or None if that is the default.

    **Raises:** the constructor raises ValueError for anything else.

    >>> import fdof_jax as fj
    >>> class Pad(fj.Element):
    ...     at: fj.forces.Point = fj.forces.of_kind(fj.forces.Point)
    ...     def __call__(self, t, q, qd, linkage):
    ...         return 0 * q
    >>> Pad("tip")
    Traceback (most recent call last):
    ValueError: at: expected a Point, got 'tip'.
    """
    return dataclasses.field(default=default, metadata={"kind": kind})


class default:
    """Decorates a method that computes an attribute unless a subclass has its own."""

    # Unlike a property, it allows a field of the same name.

    def __init__(self, compute: Callable[[Any], Any]):
        self.compute = compute

    def __get__(self, part: object, owner: type | None = None) -> Any:
        if part is None:
            raise AttributeError("found in instances only: it is no default of a field")
        return self.compute(part)


class Condition(NamedTuple):
    """A condition on the values of an element or a reference: see `Element.conditions`.

    - `holds`: a bool, or an array of which all entries must be true.
    - `name`, `expected`, `got`: parts of the message if it does not hold. A tuple `got`
      shows several values.
    """

    holds: Truth
    name: str
    expected: str
    got: object


@dataclass_transform(field_specifiers=(eqx.field, field, called, of_kind))
class _Fields(type(eqx.Module)):
    """Tells type checkers and editors the arguments of constructors."""


class Part(Frozen, metaclass=_Fields):
    """A pytree with declared arrays, conditions on them, and times of jumps.

    Elements and references are parts, and may have further ones as fields.

    >>> import fdof_jax as fj
    >>> class Range(fj.forces.Part):
    ...     lower: fj.Values = fj.field(unit="rad")
    ...     upper: fj.Values = fj.field(unit="rad")
    ...     def conditions(self):
    ...         yield from self.ordered("lower", "upper")
    >>> Range(1, -1)  # [rad]
    Traceback (most recent call last):
    ValueError: lower: expected less than upper, got 1.0 and -1.0.
    """

    def conditions(self) -> Iterable[Condition]:
        """Yields conditions besides the bounds of fields; values may be traced."""
        return ()

    def conditions_on(self, linkage: Linkage) -> Iterable[Condition]:
        """Yields conditions on the arm's joints."""
        return ()

    jump_ts = default(lambda self: jumps_of(dict(_within(self))))

    def ordered(self, first: str, second: str) -> Iterator[Condition]:
        """Yields the condition that a field is less than another, if both are given."""
        low, high = vars(self)[first], vars(self)[second]
        if low is not None and high is not None:
            expected = f"less than {second}"
            yield Condition((low < high).all(), first, expected, (low, high))

    def over_times(self, name: str, least: int) -> Iterator[Condition]:
        """Yields the conditions that `ts` increases, and a field has a row per time."""
        ts, rows = vars(self)["ts"], len(vars(self)[name])
        rising = (ts[1:] > ts[:-1]).all() & (len(ts) >= least)
        words = "two or more increasing times" if least == 2 else "increasing times"
        yield Condition(rising, "ts", words, (ts,))
        yield Condition(len(ts) == rows, name, f"{len(ts)} rows, one per time", (rows,))

    def value_of(self, name: str, *arguments: Array) -> Array:
        """Returns a declared array, or what the function in its place returns."""
        value = vars(self)[name]
        if not callable(value):
            return value
        rules = type(self).__dataclass_fields__[name].metadata["rules"]
        return real_array(name, value(*arguments), **rules)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Raises ValueError unless the part fits the arm and the times, all known."""
        for _, part in _within(self):
            part.check(linkage, ts)

    def fits(self, linkage: Linkage, ts: Array) -> Truth:
        """Returns whether the part fits the arm and the times; all may be traced."""
        # NumPy's `all` of a traced array is the array's own.
        own = [np.all(condition.holds) for condition in self.conditions_on(linkage)]
        parts = [part.fits(linkage, ts) for _, part in _within(self)]
        return reduce(and_, [*own, *parts], True)

    def possible(self) -> Truth:
        """Returns whether the constructor would accept the values, known or traced."""
        own = [np.all(condition.holds) for condition in self.conditions()]
        fields = [within_bounds(value, **rules) for _, value, rules in _declared(self)]
        parts = [part.possible() for _, part in _within(self)]
        return reduce(and_, [*own, *fields, *parts], True)

    def __repr__(self) -> str:
        try:
            values = self.arguments()
        except (TypeError, ValueError):  # traced, of a batch, or not told
            values = vars(self)
        fields = (f"{name}={_shown(value)}" for name, value in values.items())
        return f"{type(self).__name__}({', '.join(fields)})"

    def __check_init__(self):
        for declared in dataclasses.fields(self):
            name, about = declared.name, declared.metadata
            value = vars(self)[name]
            if "called" in about:
                function(name, value, about["called"])
            if "kind" in about and (value is not None or declared.default is not None):
                instance(name, value, about["kind"])
        for name, value, rules in _declared(self):
            object.__setattr__(self, name, real_array(name, value, **rules))
        try:
            _refuse("", in_numpy(self).conditions())
        except ValueError as error:
            if "broadcast" not in str(error):
                raise
            sizes = {name: np.shape(value) for name, value, _ in _declared(self)}
            several = {name: shape for name, shape in sizes.items() if shape != ()}
            raise ValueError(
                f"{', '.join(several)}: expected arrays of one length, got shapes "
                f"{', '.join(map(str, several.values()))}."
            ) from error


def _shown(value: object) -> str:
    if not isinstance(value, jax.Array | np.ndarray):
        return repr(value)
    numbers = isinstance(value.dtype, np.dtype)  # not random keys
    if numbers and value.size <= 12 and not is_traced(value):
        return short(value)
    return eqx.tree_pformat(value)


def check_values(place: str, part: Part) -> None:
    """Raises ValueError for known values that constructors would not accept."""
    for name, value, rules in _declared(part):
        real_array(f"{place}.{name}", value, **rules)
    _refuse(f"{place}.", in_numpy(part).conditions())
    for name, inner in _within(part):
        check_values(f"{place}.{name}", inner)


def _refuse(place: str, conditions: Iterable[Condition]) -> None:
    for holds, name, expected, got in conditions:
        if (known := concrete(holds)) is not None and not known.all():
            parts = got if isinstance(got, tuple) else (got,)
            text = plain(" and ".join(map(str, parts)))
            raise ValueError(f"{place}{name}: expected {expected}, got {text}.")


def _declared(part: Part) -> Iterator[tuple[str, Any, Rules]]:
    """Yields names, values and rules of the declared arrays."""
    for declared in dataclasses.fields(part):
        value, about = vars(part)[declared.name], declared.metadata
        if "rules" not in about or value is None and about["optional"]:
            continue
        called = callable(value) and not isinstance(value, type)
        if not (about["function"] and called):
            yield declared.name, value, about["rules"]


def each(values: Array, joints: Sized) -> tuple[Array, ...]:
    """Returns declared values of joints as scalars, one for each of `joints`."""
    return tuple(values) if jnp.ndim(values) else (values,) * len(joints)


def sized(part: _Part, joints: int) -> _Part:
    """Returns the part with an entry per joint where it has one number for all."""
    changes: dict[str, Part | Array] = {
        name: sized(inner, joints) for name, inner in _within(part)
    }
    for name, value, rules in _declared(part):
        if rules["shape"] == (JOINT,) and jnp.ndim(value) == 0:
            changes[name] = (
                jnp.broadcast_to(value, joints)
                if is_traced(value)
                else jax.device_put(np.full(joints, value))  # compiles nothing
            )
    changes = {n: new for n, new in changes.items() if not isinstance(new, Foreign)}
    if not changes:
        return part
    copied = object.__new__(type(part))
    for name, value in (vars(part) | changes).items():
        object.__setattr__(copied, name, value)
    return copied


def check_joints(place: str, part: Part, linkage: Linkage) -> None:
    """Raises ValueError unless arrays and known values suit the arm's joints."""
    part, linkage = in_numpy((part, linkage))
    count = joints_of(linkage)
    for name, value, rules in _declared(part):
        sizes = shape_in_rows(value, rules["rows"])
        for wanted, size in zip(rules["shape"], sizes):
            if wanted == JOINT and size != count:
                more = jnp.ndim(value) > len(rules["shape"])
                hint = "; sweep(..., forces_axes=0) takes a batch" if more else ""
                raise ValueError(
                    f"{place}{name}: expected numbers for {count} joints, as the "
                    f"linkage has, got {size}{hint}."
                )
        if rules["unit"] == "m or rad":
            check_angles(f"{place}{name}", value, linkage.ef)
    _refuse(place, part.conditions_on(linkage))
    for name, inner in _within(part):
        check_joints(f"{place}{name}.", inner, linkage)


def _within(part: Part) -> Iterator[tuple[str, Part]]:
    """Yields the fields that are parts, or are called."""
    if isinstance(part, Foreign):  # its attributes say all
        return
    for name, value in vars(part).items():
        if isinstance(value, Part):
            yield name, value
        elif callable(value) and not isinstance(value, type):
            yield name, Foreign(value)


def jumps_at(name: str, part: Part) -> Array | None:
    """Returns the times at which a part jumps (time,) [s], or None.

    Raises ValueError unless they are real numbers.
    """
    if (jumps := part.jump_ts) is None:
        return None
    several = isinstance(jumps, list | tuple) or np.ndim(jumps)
    shape, rules = (None,) if several else (), dict(finite=False, unit="s")
    times = jnp.ravel(real_array(f"{name}.jump_ts", jumps, shape, **rules))
    return times if times.size else None


def jumps_of(parts: dict[str, Part]) -> Array | None:
    """Returns all times at which parts jump, by their names, or None."""
    found = [jumps_at(name, part) for name, part in parts.items()]
    times = [jumps for jumps in found if jumps is not None]
    return jnp.concatenate(times) if times else None


def has_come(time: Array, t: Array | np.ndarray) -> Array:
    """Returns whether a known time has come at `t`, or is later by rounding alone."""
    # A run that ends at `t` and one that begins there agree on it.
    return time - 2 * jnp.finfo(time.dtype).eps * abs(time) <= t


def optional(name: str, absent: object = None) -> Any:
    """Returns an attribute of a `Foreign` that its callable may have."""
    return property(lambda self: getattr(self.called, name, absent))


class Foreign(Part):
    """A callable that is no part; it may have some of a part's attributes."""

    called: Callable

    jump_ts = optional("jump_ts")
    check = optional("check", lambda linkage, ts: None)
    possible = optional("possible", lambda: True)

    def __call__(self, *arguments: Any) -> Any:
        return self.called(*arguments)
