"""Modules that do not change, and say how to get changed ones."""

from dataclasses import FrozenInstanceError
from typing import Any, ClassVar

import equinox as eqx


class Frozen(eqx.Module):
    """A module whose refusal of an assignment names the way to other values."""

    _other: ClassVar[str] = "equinox.tree_at(lambda it: it.{0}, it, ...)"

    def __setattr__(self, name: str, value: Any) -> None:
        try:
            super().__setattr__(name, value)
        except FrozenInstanceError:
            way = self._other.format(name)
            raise FrozenInstanceError(
                f"{name}: a {type(self).__name__} does not change; {way} returns "
                "another."
            ) from None
