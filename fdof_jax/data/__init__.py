"""Tables of motions, files, and models of other engines."""

from ..base.report import Report
from ..mjcf.reading import MjcfModel, from_mjcf
from ..mjcf.writing import to_mjcf
from .files import load, save
from .tables import to_pandas, to_xarray

__all__ = [
    "from_mjcf", "load", "MjcfModel", "Report", "save", "to_mjcf", "to_pandas",
    "to_xarray",
]  # fmt: skip
__dir__ = __all__.copy
