"""Checks of arguments, for code of one's own; messages name the argument."""

from .base.checks import (
    check_known,
    function,
    instance,
    is_traced,
    one_of,
    plain,
    real_array,
    refusal,
    shown,
    whole_number,
)
from .forces.holders import check_free
from .linkage.coordinates import real_state
from .linkage.linkage import check_linkage, per_joint
from .simulation.simulate import check_scene
from .simulation.solution import check_joints

__all__ = [
    "check_free", "check_joints", "check_known", "check_linkage", "check_scene",
    "function", "instance", "is_traced", "one_of", "per_joint", "plain", "real_array",
    "real_state", "refusal", "shown", "whole_number",
]  # fmt: skip
__dir__ = __all__.copy
