"""Dynamics of planar open-chain linkages in JAX.

    import fdof_jax as fj
    fj.configure(x64=True)                     # double precision, before all else
    arm, start, forces, t1 = fj.scenes.fig7()  # or your own Linkage, State and elements
    motion = fj.simulate(arm, start, [0, t1], forces)

Units are SI. `help` of a name says the rest; its room holds more of its kind.

- **Arms**: Linkage, State, Scene, TOPOLOGIES, existence_factors, to_chain, from_chain,
  joint_positions, mass_centers, tip_position, tip_jacobian, inverse_kinematics.
- **What acts**, room `forces`: JointDamper, JointEffort, SpringDamper, Wrench, Point,
  LinearActuator. Of your own: Element, field, Values.
- **Controllers**, rooms `control` and `references`: PDController, TipTask, CircleTask.
- **Motions**: simulate, sweep for many, simulate_sampled and step for controllers on a
  clock; Solution, SampledMotion, PrescribedMotion, scale_tolerances.
- **At one instant**: forward_dynamics, inverse_dynamics, joint_mass_matrix, joint_bias,
  energy, link_energies; the paper's mass_matrix, bias_force, masked_accelerations and
  constraint_forces.
- **Afterwards**, room `analysis`: joint_efforts, Efforts, joint_reactions, linearize.
- **Gains**, room `tuning`: tune, TuneResult. **Parameters from recordings**, room
  `identification`: fit, FitResult.
- **Pictures**: drawing, plotting, interactive. **Files and tables**, room `data`: save,
  load, to_pandas, to_xarray, to_mjcf, from_mjcf.
- **The paper's figures**: scenes.
"""

import importlib
import importlib.machinery
import sys
import warnings
from typing import Any

from .base.names import attach, room_of

__version__ = "0.2.0"

# A name is imported at its first use, so that what needs no JAX starts at once.
_find, _names, __all__ = attach(__name__, __file__)


def __dir__() -> list[str]:
    return [*_names(), "__version__"]


def __getattr__(name: str) -> Any:
    if name not in __all__ and (room := room_of(name)):
        message = f"{__name__}.{name} is now {room.__name__}.{name}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return room.__getattr__(name)
    return _find(name)


class _Moved:
    """Finds the modules that users import where version 0.1 had them."""

    PLACES = {
        f"{__name__}.drawing": f"{__name__}.pictures.drawing",
        f"{__name__}.files": f"{__name__}.data.files",
        f"{__name__}.interactive": f"{__name__}.pictures.interactive",
        f"{__name__}.plotting": f"{__name__}.pictures.plotting",
    }

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> Any:
        if name not in cls.PLACES:
            return None
        own = importlib.import_module(cls.PLACES[name]).__spec__
        return importlib.machinery.ModuleSpec(name, cls, loader_state=own)  # pyright: ignore

    @staticmethod
    def create_module(spec: Any) -> Any:
        return sys.modules[spec.loader_state.name]

    @staticmethod
    def exec_module(module: Any) -> None:
        module.__spec__ = module.__spec__.loader_state


sys.meta_path.append(_Moved)  # pyright: ignore
