"""The versions of the library and of what it computes with, for files."""

import diffrax
import equinox as eqx
import jax
import numpy as np

from .. import __version__

VERSIONS = {"fdof_jax": __version__} | {
    module.__name__: module.__version__ for module in (jax, diffrax, eqx, np)
}
