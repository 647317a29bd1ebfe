"""Signatures of constructors that are made from declared fields: for griffe.

griffe reads source code, where such a constructor does not stand.
"""

import importlib
import inspect
from typing import Any

import griffe

from fdof_jax.linkage.fields import Part

KINDS = {
    inspect.Parameter.POSITIONAL_OR_KEYWORD: griffe.ParameterKind.positional_or_keyword,
    inspect.Parameter.KEYWORD_ONLY: griffe.ParameterKind.keyword_only,
}


class Constructors(griffe.Extension):
    def on_class_members(self, *, cls, **_):
        if "__init__" in cls.members or cls.parent is None or not cls.parent.is_module:
            return
        found = vars(importlib.import_module(cls.parent.path)).get(cls.name)
        if not (isinstance(found, type) and issubclass(found, Part)):
            return
        given = inspect.signature(found).parameters.values()
        own = griffe.Function("__init__", parameters=griffe.Parameters(
            griffe.Parameter("self", kind=griffe.ParameterKind.positional_only),
            *(
                griffe.Parameter(
                    each.name,
                    kind=KINDS[each.kind],
                    annotation=_shown(each.annotation),
                    default=None if each.default is each.empty else repr(each.default),
                )
                for each in given
                if each.kind in KINDS
            ),
        ))  # fmt: skip
        cls.set_member("__init__", own)


def _shown(annotation) -> str | None:
    if annotation in (inspect.Parameter.empty, Any):
        return None
    name = annotation if isinstance(annotation, str) else _name(annotation)
    return "ArrayLike" if name == "Values" else name  # an array is given as any numbers


def _name(annotation) -> str:
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)
