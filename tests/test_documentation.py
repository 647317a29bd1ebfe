"""Every public name is documented: purpose, units, source; examples run as doctests."""

import inspect
import re

import pytest

import fdof_jax as fj
from fdof_jax import scenes

PUBLIC = {
    name: value
    for module in (fj, scenes)
    for name, value in vars(module).items()
    if getattr(value, "__module__", "").startswith("fdof_jax") and callable(value)
}
# Names whose arguments or results carry no unit.
UNITLESS = {
    "existence_factors", "to_mjcf", "fig3", "fig5", "fig7", "load", "save", "stacked",
    "tune_each", "gradient_report", "league_table", "circle_scenes",
}  # fmt: skip
# Names that implement something printed in the paper.
SOURCES = {
    "mass_matrix": "(8)-(13)",
    "bias_force": "(14)",
    "masked_accelerations": "(17)-(27)",
    "constraint_forces": "(16)-(26)",
    "forward_dynamics": "(17)-(27)",
    "inverse_dynamics": "(14)",
    "energy": "(6) and (7)",
    "link_energies": "(6) and (7)",
    "existence_factors": "(4)",
    "simulate": "(17)-(27)",
    "Linkage": "Fig 1",
    "JointDamper": "Fig 3",
    "PDController": "Fig 7",
    "CircleTask": "Fig 7",
    "fig3": "Fig",
    "fig5": "Fig",
    "fig7": "Fig",
}


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_docstring(name):
    doc = inspect.getdoc(PUBLIC[name]) or ""
    assert len(doc) > 40 and doc.split("\n")[0].strip().endswith("."), doc
    if name not in UNITLESS:
        assert re.search(r"\[[^\]]*(m|rad|N|J|kg|s|degrees)[^\]]*\]", doc), doc
    if name in SOURCES:
        assert SOURCES[name] in doc


def test_the_front_door_is_complete():
    names = """TOPOLOGIES existence_factors Linkage State to_chain from_chain
    mass_matrix bias_force masked_accelerations constraint_forces forward_dynamics
    inverse_dynamics
    energy link_energies joint_positions mass_centers tip_position tip_jacobian
    inverse_kinematics JointDamper JointEffort PDController CircleTask simulate Solution
    joint_efforts to_mjcf Scene scenes tune TuneResult __version__""".split()
    assert not [name for name in names if not hasattr(fj, name)]
