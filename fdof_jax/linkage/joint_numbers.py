"""Joints by their numbers, from 1, as elements at some joints are given them."""

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
    """Returns whether each number of a joint is among those given.

    Raises ValueError for what are no numbers of joints.
    """
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
    """Returns the condition that an arm has the joints that are marked."""
    count, last = joints_of(linkage), (joints * np.array(_NUMBERS)).max()
    return Condition(last <= count, "joints", f"1 to {count}", last)


def numbers_in(joints: Array) -> np.ndarray:
    """Returns the numbers of the joints that are marked, as `numbered` marks them."""
    return np.array([number for number, marked in zip(_NUMBERS, joints) if marked])
