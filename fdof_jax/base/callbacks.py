"""Compiles programs without calls back into Python.

JAX 0.10 keeps no program with calls back into Python in its persistent cache, and no
version can export one. diffrax's run-time checks make such calls: that output times
increase, that they lie within the solve, that the first step has the right sign.
`simulate` makes these checks itself or reports violations in its result.

Equinox has one switch for such checks in the whole process, the environment variable
EQX_ON_ERROR. If a future version moves the switch, the checks stay in.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox

P = ParamSpec("P")
T = TypeVar("T")

_ERRORS: Any = equinox._errors
_CHOSEN = vars(_ERRORS).get("EQX_ON_ERROR")  # by the user's environment


@contextlib.contextmanager
def _set_to(choice: Any) -> Iterator[None]:
    before = vars(_ERRORS).get("EQX_ON_ERROR")
    if before is None:
        yield
        return
    _ERRORS.EQX_ON_ERROR = choice
    try:
        yield
    finally:
        _ERRORS.EQX_ON_ERROR = before


def without_checks():
    """Omits Equinox's run-time checks from code traced in this context."""
    return _set_to("off")


def with_checks(function: Callable[P, T]) -> Callable[P, T]:
    """Keeps run-time checks in code that `function` traces, such as user elements."""

    @functools.wraps(function)
    def checked(*args: P.args, **keywords: P.kwargs) -> T:
        with _set_to(_CHOSEN):
            return function(*args, **keywords)

    return checked
