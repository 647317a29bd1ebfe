"""Programs without calls back into Python.

JAX 0.10 keeps no program in its persistent cache that calls back into Python, and no
version can export one. diffrax's run-time checks do: that output times increase, that
they lie within the solve, that the first step has the right sign. `simulate` has made
them so before, or its result says that they are not.

Equinox has one switch for such checks, for a whole process: the environment variable
EQX_ON_ERROR. Where a future version keeps it elsewhere, the checks stay in.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox

P = ParamSpec("P")
T = TypeVar("T")

_ERRORS: Any = equinox._errors
_CHOSEN = getattr(_ERRORS, "EQX_ON_ERROR", None)  # by whoever started the process


@contextlib.contextmanager
def _set_to(choice: Any) -> Iterator[None]:
    before = getattr(_ERRORS, "EQX_ON_ERROR", None)
    if before is None:
        yield
        return
    _ERRORS.EQX_ON_ERROR = choice
    try:
        yield
    finally:
        _ERRORS.EQX_ON_ERROR = before


def without_checks():
    """Leave Equinox's run-time checks out of what is traced in this context."""
    return _set_to("off")


def with_checks(function: Callable[P, T]) -> Callable[P, T]:
    """Keep them in what this function traces: a user's own force elements, say."""

    @functools.wraps(function)
    def checked(*args: P.args, **keywords: P.kwargs) -> T:
        with _set_to(_CHOSEN):
            return function(*args, **keywords)

    return checked
