"""Immutable modules that return changed copies."""

import inspect
from dataclasses import FrozenInstanceError
from typing import Any, Self

import equinox as eqx

from .checks import plain


class Frozen(eqx.Module):
    """An immutable module with a checked `replace`."""

    def __init_subclass__(cls, **keywords: Any):
        super().__init_subclass__(**keywords)
        # Otherwise that of dataclasses, which does not know constructors.
        cls.__replace__ = cls.replace

    def __setattr__(self, name: str, value: object) -> None:
        try:
            super().__setattr__(name, value)
        except FrozenInstanceError:
            raise FrozenInstanceError(
                f"{name}: a {type(self).__name__} is immutable; its "
                f"replace({name}=...) returns a changed copy."
            ) from None

    def arguments(self) -> dict[str, Any]:
        """Returns the arguments of the constructor as a dictionary.

        A class overrides it if an argument has no field of its name.
        """
        fields, names = vars(self), inspect.signature(type(self)).parameters
        if missing := [name for name in names if name not in fields]:
            raise TypeError(
                f"{type(self).__name__}: expected a method `arguments`, because some "
                f"arguments of the constructor are no fields: {', '.join(missing)}."
            )
        return {name: fields[name] for name in names}

    def replace(self, **values: Any) -> Self:
        """Returns a checked copy with other values of some constructor arguments.

        From Python 3.13 on `copy.replace` does the same.

        **Raises:** ValueError for malformed values and unknown names.

        >>> import fdof_jax as fj
        >>> fj.scenes.fig5().linkage.replace(mass=[1, 1, 5]).mass.tolist()  # [kg]
        [1.0, 1.0, 5.0]
        """
        now = self.arguments()
        for name in values:
            if name not in now:
                raise ValueError(
                    f"{plain(name)}: expected an argument of {type(self).__name__} "
                    f"({', '.join(now)}), got another name."
                )
        return type(self)(**now | values)
