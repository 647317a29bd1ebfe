"""Chains of any number of joints, some of them fixed."""

import numpy as np
from helpers import random_linkage as random_chain

__all__ = ["moving", "random_chain"]


def moving(topology):
    """Returns whether the joint of each pair is real."""
    return np.array([joint != "F" for joint in topology])
