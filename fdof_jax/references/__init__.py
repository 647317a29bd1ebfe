"""Reference motions: moves of the joints, tasks along paths, timing."""

from .paths import Ellipse, FigureEight, Line, Path, Spline
from .reference import Reference, reachable, reference_of
from .task import CircleTask, JointMove, SetPoint, TipTask, reach_margin
from .timing import Laps, Travel

# isort: split
# Last, as `signals` imports names from above.
from ..servo.signals import Pulse, Ramp, Step

__all__ = [
    "CircleTask", "Ellipse", "FigureEight", "JointMove", "Laps", "Line", "Path",
    "Pulse", "Ramp", "reach_margin", "reachable", "Reference", "reference_of",
    "SetPoint", "Spline", "Step", "TipTask", "Travel",
]  # fmt: skip
__dir__ = __all__.copy
