"""Programs without calls back into Python.

JAX 0.10 keeps no program in its persistent cache that calls back into Python, and no
version can export one. diffrax's run-time checks do: that output times increase, that
they lie within the solve, that the first step has the right sign. `simulate` has made
them so before, or its result says that they are not.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

import equinox


@contextlib.contextmanager
def without_checks() -> Iterator[None]:
    """Leave Equinox's run-time checks out of what is traced in here.

    Equinox has a switch for a whole process only, the environment variable
    EQX_ON_ERROR. Where a future version keeps it elsewhere, the checks stay in.
    """
    errors: Any = equinox._errors
    before = getattr(errors, "EQX_ON_ERROR", None)
    if before is None:
        yield
        return
    errors.EQX_ON_ERROR = "off"
    try:
        yield
    finally:
        errors.EQX_ON_ERROR = before
