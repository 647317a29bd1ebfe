from .files import load as load, save as save
from .mjcf import to_mjcf as to_mjcf
from .mjcf_import import from_mjcf as from_mjcf
from .tables import to_pandas as to_pandas, to_xarray as to_xarray

__all__: list[str]
