from ..linkage.fields import Condition as Condition, Values as Values, field as field
from .actuators import Armature as Armature, LinearActuator as LinearActuator
from .between_points import (
    SpringDamper as SpringDamper,
    Tension as Tension,
    Wrench as Wrench,
)
from .element import (
    Element as Element,
    InertialElement as InertialElement,
    StatefulElement as StatefulElement,
)
from .joint_limits import JointFriction as JointFriction, JointStops as JointStops
from .joints import (
    EffortHistory as EffortHistory,
    JointDamper as JointDamper,
    JointEffort as JointEffort,
)
from .points import Load as Load, Point as Point, PointElement as PointElement
from .switches import clip as clip, switch as switch

__all__: list[str]
