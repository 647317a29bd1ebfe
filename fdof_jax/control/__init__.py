"""Controllers, feedforward and drives."""

from ..base.names import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
