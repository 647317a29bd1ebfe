"""Warnings that name the caller's line, however deep in the library they arise."""

import contextlib
import sys
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

import equinox as eqx
import jax

_INNER = (
    *(str(Path(name).parent) for name in (jax.__file__, eqx.__file__)),
    str(Path(__file__).parents[1]),
    contextlib.__file__,  # of decorators such as `jax.transfer_guard`
    "<@",  # functions that beartype makes
)


_OMITTED: ContextVar[str | None] = ContextVar("omitted", default=None)


@contextlib.contextmanager
def without_warning(words: str) -> Iterator[None]:
    """Omits this library's warnings with these words, in the calling thread alone."""
    # `warnings.catch_warnings` would change the filters of all threads.
    before = _OMITTED.set(words)
    try:
        yield
    finally:
        _OMITTED.reset(before)


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warns at the line outside of this library, equinox, JAX and contextlib."""
    if (omitted := _OMITTED.get()) is not None and omitted in message:
        return
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_INNER):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
