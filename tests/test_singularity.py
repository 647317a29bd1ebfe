"""Arms whose mass matrix is always singular are refused; delicate ones warn."""

import re
import warnings

import numpy as np
import pytest
from helpers import SCENES, load
from test_linkage import make

import fdof_jax as fj


@pytest.mark.parametrize(
    "topology, changes, joint, link",
    [
        # The last joint moves nothing.
        ("RRR", dict(mass=[1, 1, 0], inertia=[1, 1, 0]), 3, 3),
        ("RPR", dict(com=[[1, 0], [1, 0], [0, 0]], inertia=[1, 1, 0]), 3, 3),
        ("RRP", dict(mass=[1, 1, 0]), 3, 3),
        ("PRP", dict(mass=[1, 1, 0]), 3, 3),
        ("RPR", dict(mass=[1, 0, 0]), 2, 2),
    ],
)
def test_joints_that_move_nothing_are_refused(topology, changes, joint, link):
    kind = {"R": "revolute", "P": "prismatic"}[topology[joint - 1]]
    message = (
        rf"(?s)^mass, inertia, com: expected joint {joint} \({kind}\) of {topology} "
        rf".*link {link} .*, got none"
    )
    with pytest.raises(ValueError, match=message):
        make(topology, **changes)


ALONG = " along the same line"


@pytest.mark.parametrize(
    "topology, changes, joints, how",
    [
        (
            "RRR",
            dict(
                length=[0, 1, 0, 1],
                locked=0,
                com=[[1, 0], [0, 0], [1, 0]],
                inertia=[1, 0, 1],
            ),
            "2 and 3",
            "",
        ),
        ("RPP", dict(mass=[1, 0, 1], locked=[0.1, 0, 0.2]), "2 and 3", ALONG),
        (
            "RRP",
            dict(length=[0, 0, 1, 1], locked=0, mass=[0, 1, 1], inertia=[0, 1, 1]),
            "1 and 2",
            "",
        ),
        ("PPR", dict(mass=[0, 1, 1], locked=[np.pi, 0.2, 0.3]), "1 and 2", ALONG),
        ("PPR", dict(mass=[0, 0, 1], inertia=[1, 1, 0]), "1 and 2 and 3", ""),
    ],
)
def test_joints_that_move_nothing_together_are_refused(topology, changes, joints, how):
    message = (
        f"^mass, inertia, com: expected joints {joints} of {topology} to move some "
        f"inertia however .* against each other{how} and move none"
    )
    with pytest.raises(ValueError, match=message):
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


@pytest.mark.parametrize(
    "topology, changes, message",
    [
        ("RRR", dict(mass=[0, 1, 1], inertia=[0, 1, 1]), "link 1: .* may be singular"),
        (
            "RRR",
            dict(com=[[1, 0], [0, 0], [1, 0]], inertia=[1, 0, 1]),
            "link 2: .* may be singular",
        ),
        ("PRR", dict(mass=[0, 1, 1]), "link 1: .* may be singular"),
        ("RPR", dict(mass=[1, 0, 1]), "link 2: .* may be singular"),
        ("RRR", dict(length=[1, 0, 1, 1], locked=0), "joints 1 and 2 coincide"),
        ("PRR", dict(length=[1, 1, 0, 1], locked=0), "joints 2 and 3 coincide"),
        ("PPR", dict(locked=[0, 0.2, 0.3]), "joints 1 and 2 are parallel"),
        ("RPP", dict(locked=[0.1, np.pi, 0.3]), "joints 2 and 3 are parallel"),
        # Rigid bodies of two links.
        (
            "RFR",
            dict(mass=[0, 0, 1], inertia=[0, 0, 1]),
            "links 1 to 2: .* may be singular",
        ),
        (  # The mass is at joint 1 but for rounding.
            "RFR",
            dict(length=[1, 2, 3, 1], locked=[0, np.pi, 0], inertia=[0, 0, 1])
            | dict(mass=[0, 1, 1], com=[[1, 0], [2, 0], [1, 0]]),
            "links 1 to 2: .* may be singular",
        ),
        ("RFR", dict(length=[1, 2, 2, 1], locked=[0, np.pi, 0]), "1 and 3 coincide"),
        ("PFP", dict(locked=[0.3, np.pi - 0.3, 0]), "joints 1 and 3 are parallel"),
    ],
)
def test_delicate_linkages_warn_once_at_the_caller(topology, changes, message):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make(topology, **changes)
    assert len(caught) == 1
    assert re.search(message, str(caught[0].message))
    assert caught[0].filename == make.__code__.co_filename


@pytest.mark.parametrize(
    "topology, changes",
    [
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
    ],
)
def test_regular_linkages_pass_without_a_warning(topology, changes):
    make(topology, **changes)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_no_reference_scene_is_refused(name):
    assert np.isfinite(load(name).linkage.mass).all()
