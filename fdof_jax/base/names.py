"""Imports at the first use: of public names, and of packages that extras install."""

import ast
import importlib.util
import pathlib
import sys
from collections.abc import Callable
from typing import Any


def attach(
    package: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Returns `__getattr__`, `__dir__` and `__all__` of the package defined in `file`.

    The stub beside the file lists the names. Editors and type checkers read it too.
    """
    stub = ast.parse(pathlib.Path(file).with_suffix(".pyi").read_text())
    places = {
        name.name: importlib.util.resolve_name(
            "." * statement.level + (statement.module or ""), package
        )
        for statement in stub.body
        if isinstance(statement, ast.ImportFrom)
        for name in statement.names
    }

    def find(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = vars(importlib.import_module(places[name])).get(name)
        if value is None:  # a module
            value = importlib.import_module(f"{places[name]}.{name}")
        setattr(sys.modules[package], name, value)  # found without `find` from now on
        return value

    return find, lambda: list(places), list(places)


def room_of(name: str) -> Any:
    """Returns the room that lists a public name, or None."""
    rooms = "analysis control forces identification references tuning".split()
    for room in rooms:
        module = importlib.import_module(f"...{room}", __name__)
        if name in module.__all__:
            return module
    return None


def optional_package(name: str, extra: str) -> Any:
    """Returns the package, or raises ImportError that names the extra to install."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{name} is not installed: pip install 'fdof_jax[{extra}]' installs it."
        ) from error
