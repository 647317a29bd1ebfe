"""Force elements: joint efforts, springs, dampers, stops, actuators."""

from ..linkage.fields import Condition, Part, Values, called, field, of_kind
from .actuators import Armature, LinearActuator, Rotor
from .added_inertia import present
from .element import (
    Element,
    InertialElement,
    StatefulElement,
    element_of,
    elements_on,
    naming,
)
from .holders import Brake, HardStops, JointFriction, stribeck
from .joints import EffortHistory, JointDamper, JointEffort, JointSpring, JointStops
from .payload import Payload
from .points import Load, Point, PointElement, SpringDamper, Tension, Wrench
from .reset import Reset
from .switches import clip, switch

__all__ = [
    "Armature", "Brake", "called", "clip", "Condition", "EffortHistory", "Element",
    "element_of", "elements_on", "field", "HardStops", "InertialElement", "JointDamper",
    "JointEffort", "JointFriction", "JointSpring", "JointStops", "LinearActuator",
    "Load", "naming", "of_kind", "Part", "Payload", "Point", "PointElement", "present",
    "Reset", "Rotor", "SpringDamper", "StatefulElement", "stribeck", "switch",
    "Tension", "Values", "Wrench",
]  # fmt: skip
__dir__ = __all__.copy
