"""Dynamics of planar open-chain linkages in JAX."""

import ast
import importlib
import pathlib
from typing import Any

__version__ = "0.1.0"

# A name is imported at its first use, so that what needs no JAX starts at once. The
# stub beside this file lists the names; editors and type checkers read it too.
_STUB = ast.parse(pathlib.Path(__file__).with_suffix(".pyi").read_text())
_MODULE_OF = {
    name.name: statement.module or name.name
    for statement in _STUB.body
    if isinstance(statement, ast.ImportFrom)
    for name in statement.names
}
__all__ = list(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f".{_MODULE_OF[name]}", __name__)
    value = module if name == _MODULE_OF[name] else getattr(module, name)
    globals()[name] = value  # found without this function from now on
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
