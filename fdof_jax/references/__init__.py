"""Reference motions: moves of the joints, tasks along paths, timing."""

from .paths import Ellipse, FigureEight, Line, Path, Spline
from .reference import Reference, reachable, reference_of
from .signals import Pulse, Ramp, Step
from .task import CircleTask, JointMove, SetPoint, TipTask, reach_margin
from .timing import Laps, Travel

__all__ = [
    "CircleTask", "Ellipse", "FigureEight", "JointMove", "Laps", "Line", "Path",
    "Pulse", "Ramp", "reach_margin", "reachable", "Reference", "reference_of",
    "SetPoint", "Spline", "Step", "TipTask", "Travel",
]  # fmt: skip
__dir__ = __all__.copy
