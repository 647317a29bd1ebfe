"""Dynamics of planar open-chain linkages in JAX."""

import ast
import importlib
import importlib.machinery
import pathlib
import sys
from typing import Any

__version__ = "0.2.0"

# A name is imported at its first use, so that what needs no JAX starts at once. The
# stub beside this file lists the names; editors and type checkers read it too.
_STUB = ast.parse(pathlib.Path(__file__).with_suffix(".pyi").read_text())
_MODULE_OF = {
    name.name: statement.module or ""
    for statement in _STUB.body
    if isinstance(statement, ast.ImportFrom)
    for name in statement.names
}
__all__ = list(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place = ".".join(filter(None, [__name__, _MODULE_OF[name]]))
    value = vars(importlib.import_module(place)).get(name)
    if value is None:  # a module
        value = importlib.import_module(f"{place}.{name}")
    globals()[name] = value  # found without this function from now on
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


class _Moved:
    """Finds the modules that users import where version 0.1 had them."""

    PLACES = {
        f"{__name__}.drawing": f"{__name__}.pictures.drawing",
        f"{__name__}.files": f"{__name__}.data.files",
        f"{__name__}.interactive": f"{__name__}.pictures.interactive",
        f"{__name__}.plotting": f"{__name__}.pictures.plotting",
    }

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> Any:
        if name not in cls.PLACES:
            return None
        own = importlib.import_module(cls.PLACES[name]).__spec__
        return importlib.machinery.ModuleSpec(name, cls, loader_state=own)  # pyright: ignore

    @staticmethod
    def create_module(spec: Any) -> Any:
        return sys.modules[spec.loader_state.name]

    @staticmethod
    def exec_module(module: Any) -> None:
        module.__spec__ = module.__spec__.loader_state


sys.meta_path.append(_Moved)  # pyright: ignore
