"""Linkages as data: existence factors, coordinates, rejected arms."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SCENES, load, random_linkage

import fdof_jax as fj

FIELDS = {
    "ef": (6,),
    "length": (4,),
    "com": (3, 2),
    "mass": (3,),
    "inertia": (3,),
    "locked": (3,),
    "base_angle": (),
    "gravity": (),
}


def make(topology="RRR", **changes):
    arguments = dict(
        length=[0.5, 1, 1.2, 0.8],
        com=[[0.4, 0.1], [0.6, -0.2], [0.3, 0.1]],
        mass=[2, 1.5, 1],
        inertia=[0.2, 0.1, 0.3],
        locked=[0.1, 0.7, -0.4],
        base_angle=0.3,
    )
    return fj.Linkage(topology, **{**arguments, **changes})


# Existence factors and fields


def test_the_seven_topologies_have_a_turning_joint_each():
    assert sorted(fj.TOPOLOGIES) == sorted(
        a + b + c for a in "RP" for b in "RP" for c in "RP" if a + b + c != "PPP"
    )


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_existence_factors_spell_the_topology(topology):
    ef = np.asarray(fj.existence_factors(topology))
    assert ef.shape == (6,) and ef.dtype == float
    pairs = ef.reshape(3, 2)
    assert (pairs.sum(axis=1) == 1).all()  # equation (4)
    assert "".join("PR"[int(r)] for r in pairs[:, 1]) == topology


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_a_name_and_its_existence_factors_make_the_same_linkage(topology):
    named = make(topology)
    factors = [int(f) for f in fj.existence_factors(topology)]
    for given in (factors, tuple(factors), np.array(factors), jnp.array(factors)):
        other = make(given)
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(other, name), getattr(named, name))


def test_every_field_is_an_array_leaf_of_the_default_float_type():
    linkage = make(length=[0, 1, 2, 3], locked=0, base_angle=0, gravity=10)
    for name, shape in FIELDS.items():
        value = getattr(linkage, name)
        assert isinstance(value, jax.Array)
        assert value.shape == shape and value.dtype == jnp.result_type(float), name
        assert not value.weak_type, name  # a weak type would compile once more
    assert len(jax.tree.leaves(linkage)) == len(FIELDS)
    assert linkage.locked.tolist() == [0, 0, 0]


def test_linkages_of_all_topologies_share_one_trace():
    traces = []

    @jax.jit
    def total(linkage):
        traces.append(None)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(linkage))

    for topology in fj.TOPOLOGIES:
        total(make(topology))
    assert len(traces) == 1


def test_the_default_gravity_is_standard_and_the_base_level():
    linkage = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[1, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
    )
    assert float(linkage.gravity) == 9.81
    assert float(linkage.base_angle) == 0
    assert linkage.locked.tolist() == [0, 0, 0]


# Two sets of coordinates


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_chain_coordinates_written_out(topology):
    rng = np.random.default_rng(1)
    linkage = random_linkage(topology, rng)
    q, qd = rng.normal(size=(2, 3))
    x, xd = fj.to_chain(linkage, q, qd)
    angle, rate = float(linkage.base_angle), 0.0
    for k, joint in enumerate(topology):
        slide, slide_rate = float(linkage.locked[k]), 0.0
        if joint == "R":
            angle, rate = angle + q[k], rate + qd[k]
        else:
            angle = angle + slide
            slide, slide_rate = q[k], qd[k]
        np.testing.assert_allclose(x[2 * k : 2 * k + 2], [slide, angle], atol=1e-14)
        np.testing.assert_allclose(
            xd[2 * k : 2 * k + 2], [slide_rate, rate], atol=1e-14
        )


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_from_chain_inverts_to_chain(topology):
    rng = np.random.default_rng(2)
    for _ in range(5):
        linkage = random_linkage(topology, rng)
        q, qd = 10 * rng.normal(size=(2, 3))
        x, xd = fj.to_chain(linkage, q, qd)
        for given in (topology, linkage.ef):
            locked, state = fj.from_chain(given, x, xd, linkage.base_angle)
            np.testing.assert_allclose(locked, linkage.locked, atol=1e-13)
            np.testing.assert_allclose(state.q, q, atol=1e-13)
            np.testing.assert_allclose(state.qd, qd, atol=1e-13)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
@pytest.mark.parametrize("moving", range(3))
def test_from_chain_refuses_velocities_of_locked_joints(topology, moving):
    rng = np.random.default_rng(3)
    linkage = random_linkage(topology, rng)
    x, xd = fj.to_chain(linkage, rng.normal(size=3), rng.normal(size=3))
    xd = np.array(xd)
    if topology[moving] == "R":
        xd[2 * moving] = 1e-6
        name = f"B{moving + 1} rate 0"
    else:
        xd[2 * moving + 1 :: 2] += 1e-6  # this and all later links turn on
        name = f"th{moving + 2} rate"
    with pytest.raises(ValueError, match=rf"^xd: expected {name}.*, got .*1e-06"):
        fj.from_chain(topology, x, xd, linkage.base_angle)


def test_from_chain_can_be_traced():
    linkage = make("RPR")
    x, xd = fj.to_chain(linkage, [0.1, 0.2, 0.3], [0.4, 0.5, 0.6])
    states = jax.vmap(
        lambda ef, xd: fj.from_chain(ef, x, xd, linkage.base_angle),
    )(jnp.stack([linkage.ef] * 2), jnp.stack([xd, 2 * xd]))[1]
    np.testing.assert_allclose(states.q, [[0.1, 0.2, 0.3]] * 2)
    np.testing.assert_allclose(states.qd, [[0.4, 0.5, 0.6], [0.8, 1.0, 1.2]])


# Impossible linkages, and ill-conditioned ones


@pytest.mark.parametrize(
    "topology, changes, joint, link",
    [
        # The last joint moves nothing.
        ("RRR", dict(mass=[1, 1, 0], inertia=[1, 1, 0]), 3, 3),
        ("RPR", dict(com=[[1, 0], [1, 0], [0, 0]], inertia=[1, 1, 0]), 3, 3),
        ("RRP", dict(mass=[1, 1, 0]), 3, 3),
        ("PRP", dict(mass=[1, 1, 0]), 3, 3),
        # The middle joint moves nothing that the last does not move.
        (
            "RRR",
            dict(
                length=[0, 1, 0, 1],
                locked=0,
                com=[[1, 0], [0, 0], [1, 0]],
                inertia=[1, 0, 1],
            ),
            2,
            2,
        ),
        ("RPR", dict(mass=[1, 0, 0]), 2, 2),
        ("RPP", dict(mass=[1, 0, 1], locked=[0.1, 0, 0.2]), 2, 2),
        # The first joint does not either.
        (
            "RRP",
            dict(length=[0, 0, 1, 1], locked=0, mass=[0, 1, 1], inertia=[0, 1, 1]),
            1,
            1,
        ),
        ("PPR", dict(mass=[0, 1, 1], locked=[np.pi, 0.2, 0.3]), 1, 1),
        ("PPR", dict(mass=[0, 0, 1], inertia=[1, 1, 0]), 1, 1),
    ],
)
def test_always_singular_linkages_are_refused(topology, changes, joint, link):
    kind = {"R": "revolute", "P": "prismatic"}[topology[joint - 1]]
    message = (
        rf"(?s)^mass, inertia, com: expected joint {joint} \({kind}\) of {topology} "
        rf".*link {link} .*, got "
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
        (
            "RRR",
            dict(mass=[0, 1, 1], inertia=[0, 1, 1]),
            "link 1 .* may be singular",
        ),
        (
            "RRR",
            dict(com=[[1, 0], [0, 0], [1, 0]], inertia=[1, 0, 1]),
            "link 2 .* may be singular",
        ),
        ("PRR", dict(mass=[0, 1, 1]), "link 1 .* may be singular"),
        ("RPR", dict(mass=[1, 0, 1]), "link 2 .* may be singular"),
        ("RRR", dict(length=[1, 0, 1, 1], locked=0), "joints 1 and 2 coincide"),
        ("PRR", dict(length=[1, 1, 0, 1], locked=0), "joints 2 and 3 coincide"),
        ("PPR", dict(locked=[0, 0.2, 0.3]), "joints 1 and 2 are parallel"),
        ("RPP", dict(locked=[0.1, np.pi, 0.3]), "joints 2 and 3 are parallel"),
    ],
)
def test_delicate_linkages_warn_once_at_the_caller(topology, changes, message):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make(topology, **changes)
    assert len(caught) == 1
    assert re.search(message, str(caught[0].message))
    assert caught[0].filename == __file__


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
        ("RRR", dict(mass=[1e3, 1, 1e-3], inertia=[1e-9] * 3, gravity=-9.81)),
    ],
)
@pytest.mark.filterwarnings("error")
def test_regular_linkages_pass_without_a_warning(topology, changes):
    make(topology, **changes)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_no_reference_scene_is_refused(name):
    assert np.isfinite(load(name).linkage.mass).all()


# Traced linkages: shapes are known, values are not


def test_linkages_are_built_under_jit_and_vmap():
    factors = jnp.stack([fj.existence_factors(t) for t in fj.TOPOLOGIES])
    masses = jnp.tile(jnp.linspace(1, 2, 7)[:, None], 3)
    batch = jax.jit(jax.vmap(lambda ef, mass: make(ef, mass=mass)))(factors, masses)
    for name, shape in FIELDS.items():
        assert getattr(batch, name).shape == (7, *shape)
    np.testing.assert_array_equal(batch.ef, factors)
    np.testing.assert_array_equal(batch.mass, masses)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, 0.0])
@pytest.mark.filterwarnings("error")
def test_traced_values_are_not_checked(value):
    linkage = jax.jit(lambda v: make(mass=v * jnp.ones(3), inertia=v * jnp.ones(3)))(
        value
    )
    np.testing.assert_array_equal(linkage.mass, [value] * 3)


@pytest.mark.parametrize("name", ["topology", *(n for n in FIELDS if n != "ef")])
def test_traced_shapes_are_checked(name):
    def build(v):
        return make(**{name: v})

    with pytest.raises(ValueError, match=rf"^{name}: expected .*, got "):
        jax.jit(build)(jnp.ones((2, 5)))


def test_a_concrete_field_is_checked_next_to_a_traced_one():
    with pytest.raises(ValueError, match="^mass: expected .*, got"):
        jax.jit(lambda length: make(length=length, mass=[1, -1, 1]))(jnp.ones(4))


# Other values


def test_a_copy_with_other_values():
    arm = fj.scenes.fig7().linkage
    heavy = arm.replace(mass=[1, 2, 3], topology="RRP")
    np.testing.assert_array_equal(heavy.mass, [1, 2, 3])
    np.testing.assert_array_equal(heavy.ef, fj.existence_factors("RRP"))
    np.testing.assert_array_equal(heavy.length, arm.length)
    assert jax.tree.structure(heavy) == jax.tree.structure(arm)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"masses": 1}, "^masses: expected one of topology, length, .*, gravity, got"),
        ({"mass": [-1, 1, 1]}, "^mass: expected .* at least 0, got"),
        ({"topology": "RRQ"}, "^topology: expected"),
    ],
)
def test_a_copy_is_checked_as_a_new_one(values, words):
    with pytest.raises(ValueError, match=words):
        fj.scenes.fig7().linkage.replace(**values)
