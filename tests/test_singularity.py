"""Arms whose mass matrix is always singular are refused; delicate ones warn."""

import re
import warnings

import numpy as np
import pytest
from test_linkage import make

import fdof_jax as fj

TOGETHER = r"joints {} of {} to move some .* against each other{} and move none".format
ALONG = " along the same line"
COINCIDING = dict(length=[0, 1, 0, 1], locked=0, com=[[1, 0], [0, 0], [1, 0]])


@pytest.mark.parametrize("topology, changes, message", [
    # The last joint moves nothing.
    ("RRR", dict(mass=[1, 1, 0], inertia=[1, 1, 0]), r"3 \(revolute\) .*link 3 "),
    ("RPR", dict(com=[[1, 0], [1, 0], [0, 0]], inertia=[1, 1, 0]), "joint 3 .*link 3 "),
    ("RRP", dict(mass=[1, 1, 0]), r"joint 3 \(prismatic\) of RRP .*link 3 "),
    ("PRP", dict(mass=[1, 1, 0]), r"joint 3 \(prismatic\) of PRP .*link 3 "),
    ("RPR", dict(mass=[1, 0, 0]), r"joint 2 \(prismatic\) of RPR .*link 2 "),
    # Joints together move nothing.
    ("RRR", COINCIDING | dict(inertia=[1, 0, 1]), TOGETHER("2 and 3", "RRR", "")),
    ("RPP", dict(mass=[1, 0, 1], locked=[0.1, 0, 0.2]),
     TOGETHER("2 and 3", "RPP", ALONG)),
    ("RRP", dict(length=[0, 0, 1, 1], locked=0, mass=[0, 1, 1], inertia=[0, 1, 1]),
     TOGETHER("1 and 2", "RRP", "")),
    ("PPR", dict(mass=[0, 1, 1], locked=[np.pi, 0.2, 0.3]),
     TOGETHER("1 and 2", "PPR", ALONG)),
    ("PPR", dict(mass=[0, 0, 1], inertia=[1, 1, 0]),
     TOGETHER("1 and 2 and 3", "PPR", "")),
    ("PPP", dict(mass=[0, 0, 1]), TOGETHER("1 and 2 and 3", "PPP", "")),
])  # fmt: skip
def test_joints_that_move_nothing_are_refused(topology, changes, message):
    with pytest.raises(ValueError, match=f"^mass, inertia, com: expected .*{message}"):
        make(topology, **changes)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_single_point_mass_cannot_load_three_joints(topology):
    # It has two degrees of freedom, whatever the geometry.
    rng = np.random.default_rng(4)
    for _ in range(60):
        with pytest.raises(ValueError, match="^mass, inertia, com: expected joint"):
            make(
                topology,
                length=rng.uniform(0.1, 2, 4),
                com=rng.uniform(-1, 1, (3, 2)),
                locked=rng.uniform(-1, 1, 3),
                mass=[0, 0, 1],
                inertia=[0, 0, 0],
            )


FOLDED = dict(length=[1, 2, 2, 1], locked=[0, np.pi, 0])


@pytest.mark.parametrize("topology, changes, message", [
    ("RRR", dict(mass=[0, 1, 1], inertia=[0, 1, 1]), "of link 1: .* may be singular"),
    ("RRR", dict(com=[[1, 0], [0, 0], [1, 0]], inertia=[1, 0, 1]), "of link 2: "),
    ("PRR", dict(mass=[0, 1, 1]), "of link 1: .* may be singular"),
    ("RPR", dict(mass=[1, 0, 1]), "of link 2: .* may be singular"),
    ("RRR", dict(length=[1, 0, 1, 1], locked=0), "joints 1 and 2 coincide"),
    ("PRR", dict(length=[1, 1, 0, 1], locked=0), "joints 2 and 3 coincide"),
    ("PPR", dict(locked=[0, 0.2, 0.3]), "joints 1 and 2 are parallel"),
    ("RPP", dict(locked=[0.1, np.pi, 0.3]), "joints 2 and 3 are parallel"),
    # Rigid bodies of two links; in the second the mass is at joint 1 but for rounding.
    ("RFR", dict(mass=[0, 0, 1], inertia=[0, 0, 1]), "of links 1 to 2: .* be singular"),
    ("RFR", FOLDED | dict(length=[1, 2, 3, 1], inertia=[0, 0, 1], mass=[0, 1, 1],
                          com=[[1, 0], [2, 0], [1, 0]]), "of links 1 to 2: "),
    ("RFR", FOLDED, "1 and 3 coincide"),
    ("PFP", dict(locked=[0.3, np.pi - 0.3, 0]), "joints 1 and 3 are parallel"),
])  # fmt: skip
def test_delicate_linkages_warn_once_at_the_caller(topology, changes, message):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make(topology, **changes)
    assert len(caught) == 1
    assert re.search(message, str(caught[0].message))
    assert caught[0].filename == make.__code__.co_filename


@pytest.mark.parametrize("topology, changes", [
    *((topology, {}) for topology in fj.TOPOLOGIES),
    ("RRR", dict(inertia=[0, 0, 0])),  # point masses away from their joints
    ("RRR", dict(mass=[1, 1, 0])),  # inertia alone carries the tip
    ("RRP", dict(com=[[1, 0], [1, 0], [0, 0]], inertia=[1, 1, 0])),
    ("RRR", dict(length=[0, 0, 1, 1])),  # the locked slide keeps the joints apart
    ("RPR", dict(length=[0, 0, 0, 0])),  # no two revolute joints in sequence
    ("PRP", dict(locked=0)),  # nor two prismatic ones
    ("RFR", dict(mass=[0, 1, 1], inertia=[0, 0, 1])),  # the fixed link carries
    ("RFR", dict(length=[1, 0, 1, 1], locked=0)),  # and keeps the joints apart
    ("FRP", dict(mass=[0, 1, 1], inertia=[0, 0, 0])),  # a part of the ground
    ("RRR", dict(mass=[1e3, 1, 1e-3], inertia=[1e-9] * 3, gravity=-9.81)),
])  # fmt: skip
def test_regular_linkages_pass_without_a_warning(topology, changes):
    make(topology, **changes)
