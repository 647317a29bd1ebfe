"""Dynamics of planar open-chain linkages in JAX."""

import importlib
import importlib.machinery
import sys
import warnings
from typing import Any

from .base.names import attach, room_of

__version__ = "0.2.0"

# A name is imported at its first use, so that what needs no JAX starts at once.
_find, _names, __all__ = attach(__name__, __file__)


def __dir__() -> list[str]:
    return [*_names(), "__version__"]


def __getattr__(name: str) -> Any:
    if name not in __all__ and (room := room_of(name)):
        message = f"{__name__}.{name} is now {room.__name__}.{name}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return room.__getattr__(name)
    return _find(name)


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
