"""Force elements: joint efforts, springs, dampers, stops, actuators."""

from ..base.names import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
