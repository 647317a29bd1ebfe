"""Arms whose mass matrix is always singular are refused; delicate ones warn."""

import re
import warnings

import numpy as np
import pytest

import fdof_jax as fj

REFUSED = "^mass, inertia, com: expected joint"
AGAINST = REFUSED + "s {} .* against each other"
FOLDED = dict(length=[1, 2, 2, 1], locked=[0, np.pi, 0])


def make(topology, **changes):
    arguments = dict(
        length=[0.5, 1, 1.2, 0.8], com=[[0.4, 0.1], [0.6, -0.2], [0.3, 0.1]],
        mass=[2, 1.5, 1], inertia=[0.2, 0.1, 0.3], locked=[0.1, 0.7, -0.4],
        base_angle=0.3,
    )  # fmt: skip
    return fj.Linkage(topology, **arguments | changes)


@pytest.mark.parametrize("topology, changes, words", [
    # The last joint moves nothing.
    ("RRR", dict(mass=[1, 1, 0], inertia=[1, 1, 0]), f"{REFUSED} 3 .*link 3"),
    ("RPR", dict(com=[[1, 0], [1, 0], [0, 0]], inertia=[1, 1, 0]), f"{REFUSED} 3 "),
    ("PRP", dict(mass=[1, 1, 0]), f"{REFUSED} 3 .*link 3"),
    ("RPR", dict(mass=[1, 0, 0]), f"{REFUSED} 2 .*link 2"),
    # Joints together move nothing.
    ("RRR", dict(length=[0, 1, 0, 1], locked=0, com=[[1, 0], [0, 0], [1, 0]],
                 inertia=[1, 0, 1]), AGAINST.format("2 and 3")),
    ("RPP", dict(mass=[1, 0, 1], locked=[0.1, 0, 0.2]), AGAINST.format("2 and 3")),
    ("RRP", dict(length=[0, 0, 1, 1], locked=0, mass=[0, 1, 1], inertia=[0, 1, 1]),
     AGAINST.format("1 and 2")),
    ("PPP", dict(mass=[0, 0, 1]), AGAINST.format("1 and 2 and 3")),
    # Singular in some configurations.
    ("RRR", dict(mass=[0, 1, 1], inertia=[0, 1, 1]), "of link 1: .* may be singular"),
    ("RRR", dict(com=[[1, 0], [0, 0], [1, 0]], inertia=[1, 0, 1]), "of link 2: "),
    ("PRR", dict(length=[1, 1, 0, 1], locked=0), "joints 2 and 3 coincide"),
    ("RPP", dict(locked=[0.1, np.pi, 0.3]), "joints 2 and 3 are parallel"),
    # Rigid bodies of two links; in the second the mass is at joint 1 but for rounding.
    ("RFR", dict(mass=[0, 0, 1], inertia=[0, 0, 1]), "of links 1 to 2: .* be singular"),
    ("RFR", FOLDED | dict(length=[1, 2, 3, 1], inertia=[0, 0, 1], mass=[0, 1, 1],
                          com=[[1, 0], [2, 0], [1, 0]]), "of links 1 to 2: "),
    ("RFR", FOLDED, "1 and 3 coincide"),
    ("PFP", dict(locked=[0.3, np.pi - 0.3, 0]), "joints 1 and 3 are parallel"),
    # Regular.
    ("RRR", dict(inertia=[0, 0, 0]), None),  # point masses away from their joints
    ("RRR", dict(mass=[1, 1, 0]), None),  # inertia alone carries the tip
    ("RRP", dict(com=[[1, 0], [1, 0], [0, 0]], inertia=[1, 1, 0]), None),
    ("RRR", dict(length=[0, 0, 1, 1]), None),  # the locked slide keeps joints apart
    ("RPR", dict(length=[0, 0, 0, 0]), None),  # no two revolute joints in sequence
    ("PRP", dict(locked=0), None),  # nor two prismatic ones
    ("RFR", dict(mass=[0, 1, 1], inertia=[0, 0, 1]), None),  # the fixed link carries
    ("RFR", dict(length=[1, 0, 1, 1], locked=0), None),  # and keeps the joints apart
    ("FRP", dict(mass=[0, 1, 1], inertia=[0, 0, 0]), None),  # a part of the ground
    ("RRR", dict(mass=[1e3, 1, 1e-3], inertia=[1e-9] * 3), None),
])  # fmt: skip
def test_what_is_said_of_an_arm(topology, changes, words):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            make(topology, **changes)
            said = [str(one.message) for one in caught]
        except ValueError as error:
            said = [str(error)]
    assert len(said) == bool(words) and re.search(words or "", "".join(said))
    assert all(one.filename == __file__ for one in caught)  # that of the caller


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_single_point_mass_cannot_load_three_joints(topology):
    """It has two degrees of freedom, whatever the geometry."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        com, locked = rng.uniform(-1, 1, (3, 2)), rng.uniform(-1, 1, 3)
        anywhere = dict(length=rng.uniform(0.1, 2, 4), com=com, locked=locked)
        with pytest.raises(ValueError, match=REFUSED):
            make(topology, mass=[0, 0, 1], inertia=[0, 0, 0], **anywhere)
