from .circle import CircleTask as CircleTask
from .paths import (
    Ellipse as Ellipse,
    FigureEight as FigureEight,
    Line as Line,
    Path as Path,
    Spline as Spline,
)
from .reference import Reference as Reference, reachable as reachable
from .task import JointMove as JointMove, TipTask as TipTask
from .timing import Laps as Laps, Travel as Travel, shock_against as shock_against

__all__: list[str]
