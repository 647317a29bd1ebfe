"""Arms: links, joints, coordinates, frames, singular arms."""

from .coordinates import State
from .frames import Frames, link_frames
from .linkage import Linkage, joint_names, joints_of, moving_joints, without_fixed
from .topology import TOPOLOGIES, existence_factors

__all__ = [
    "existence_factors", "Frames", "joint_names", "joints_of", "link_frames", "Linkage",
    "moving_joints", "State", "TOPOLOGIES", "without_fixed",
]  # fmt: skip
__dir__ = __all__.copy
