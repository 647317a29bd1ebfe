"""Checks of arguments, for code of one's own; messages name the argument."""

from .base.checks import (
    check_known,
    function,
    instance,
    one_of,
    plain,
    real_array,
    refusal,
    shown,
    whole_number,
)
from .linkage.linkage import check_linkage, per_joint
from .simulation.simulate import check_scene
from .simulation.solution import check_joints

__all__ = [
    "check_joints", "check_known", "check_linkage", "check_scene", "function",
    "instance", "one_of", "per_joint", "plain", "real_array", "refusal", "shown",
    "whole_number",
]  # fmt: skip
__dir__ = __all__.copy
