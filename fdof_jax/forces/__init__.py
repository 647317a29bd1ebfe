"""Force elements: joint efforts, springs, dampers, stops, actuators."""

from ..linkage.fields import Condition, Values, field
from .actuators import Armature, LinearActuator, Rotor
from .element import Element, InertialElement, StatefulElement
from .joints import (
    EffortHistory,
    JointDamper,
    JointEffort,
    JointFriction,
    JointSpring,
    JointStops,
)
from .points import Load, Point, PointElement, SpringDamper, Tension, Wrench
from .switches import clip, switch

__all__ = [
    "Armature", "clip", "Condition", "EffortHistory", "Element", "field",
    "InertialElement", "JointDamper", "JointEffort", "JointFriction", "JointSpring",
    "JointStops", "LinearActuator", "Load", "Point", "PointElement", "Rotor",
    "SpringDamper", "StatefulElement", "switch", "Tension", "Values", "Wrench",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
