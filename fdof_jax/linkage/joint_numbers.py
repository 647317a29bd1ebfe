"""Joints by their numbers, from 1."""

from typing import Any

import jax
import numpy as np
from jax import Array

from ..base.checks import array_of, check_known, refusal
from .fields import Condition
from .linkage import Linkage, joints_of
from .topology import MOST_PAIRS

_NUMBERS = tuple(range(1, MOST_PAIRS + 1))


def numbered(joints: Any) -> Array:
    """Returns a mask of the joints with the given numbers, or raises ValueError."""
    check_known("joints", joints)
    given: Any = joints
    try:
        if isinstance(joints, Array | np.ndarray):
            given = array_of(joints).tolist()
    except (RuntimeError, TypeError):  # deleted, masked, or random keys
        given = None
    numbers = given if isinstance(given, list | tuple) else (given,)
    if not numbers or any(
        isinstance(n, bool) or not isinstance(n, int) or n not in _NUMBERS
        for n in numbers
    ):
        expected = f"a number of 1 to {_NUMBERS[-1]}, or several such"
        raise refusal("joints", expected, joints)
    return jax.device_put(np.isin(_NUMBERS, numbers))


def among_joints(joints: Array, linkage: Linkage) -> Condition:
    """Returns the condition that an arm has all joints of a mask."""
    count, last = joints_of(linkage), (joints * np.array(_NUMBERS)).max()
    return Condition(last <= count, "joints", f"1 to {count}", last)


def numbers_in(joints: Array) -> np.ndarray:
    """Returns the numbers of the joints of a mask."""
    return np.array([number for number, marked in zip(_NUMBERS, joints) if marked])
