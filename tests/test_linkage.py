"""Linkages as data: existence factors, coordinates, copies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_linkage

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
def test_existence_factors_spell_the_topology_and_stand_for_its_name(topology):
    ef = np.asarray(fj.existence_factors(topology))
    assert ef.shape == (6,) and ef.dtype == float
    pairs = ef.reshape(3, 2)
    assert (pairs.sum(axis=1) == 1).all()  # equation (4)
    assert "".join("PR"[int(r)] for r in pairs[:, 1]) == topology
    for given in ([int(f) for f in ef], tuple(ef), ef, jnp.array(ef)):
        jax.tree.map(np.testing.assert_array_equal, make(given), make(topology))


def test_every_field_is_an_array_leaf_of_the_default_float_type():
    linkage = make(length=[0, 1, 2, 3], locked=0)
    for name, shape in FIELDS.items():
        value = getattr(linkage, name)
        assert isinstance(value, jax.Array)
        assert value.shape == shape and value.dtype == jnp.result_type(float), name
        assert not value.weak_type, name  # a weak type would compile once more
    assert len(jax.tree.leaves(linkage)) == len(FIELDS)
    assert linkage.locked.tolist() == [0, 0, 0]
    assert float(linkage.gravity) == 9.81  # by default


def test_linkages_of_all_topologies_share_one_trace():
    traces = []

    @jax.jit
    def total(linkage):
        traces.append(None)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(linkage))

    for topology in fj.TOPOLOGIES:
        total(make(topology))
    assert len(traces) == 1


# Two sets of coordinates


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_chain_coordinates_written_out(topology):
    rng = np.random.default_rng(1)
    linkage = random_linkage(topology, rng)
    q, qd = rng.normal(size=(2, 3))
    x, xd = fj.paper.to_chain(linkage, q, qd)
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
        x, xd = fj.paper.to_chain(linkage, q, qd)
        for given in (topology, linkage.ef):
            locked, state = fj.paper.from_chain(given, x, xd, linkage.base_angle)
            np.testing.assert_allclose(locked, linkage.locked, atol=1e-13)
            np.testing.assert_allclose(state.q, q, atol=1e-13)
            np.testing.assert_allclose(state.qd, qd, atol=1e-13)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
@pytest.mark.parametrize("moving", range(3))
def test_from_chain_refuses_velocities_of_locked_joints(topology, moving):
    rng = np.random.default_rng(3)
    linkage = random_linkage(topology, rng)
    x, xd = fj.paper.to_chain(linkage, rng.normal(size=3), rng.normal(size=3))
    xd = np.array(xd)
    if topology[moving] == "R":
        xd[2 * moving] = 1e-6
        name = f"B{moving + 1} rate 0"
    else:
        xd[2 * moving + 1 :: 2] += 1e-6  # this and all later links turn on
        name = f"th{moving + 2} rate"
    with pytest.raises(ValueError, match=rf"^xd: expected {name}.*, got .*1e-06"):
        fj.paper.from_chain(topology, x, xd, linkage.base_angle)


def test_from_chain_can_be_traced():
    linkage = make("RPR")
    x, xd = fj.paper.to_chain(linkage, [0.1, 0.2, 0.3], [0.4, 0.5, 0.6])
    states = jax.vmap(
        lambda ef, xd: fj.paper.from_chain(ef, x, xd, linkage.base_angle)
    )(jnp.stack([linkage.ef] * 2), jnp.stack([xd, 2 * xd]))[1]
    np.testing.assert_allclose(states.q, [[0.1, 0.2, 0.3]] * 2)
    np.testing.assert_allclose(states.qd, [[0.4, 0.5, 0.6], [0.8, 1.0, 1.2]])


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
    copied = arm.__replace__(mass=[1, 2, 3])  # by `copy.replace`, from Python 3.13
    np.testing.assert_array_equal(copied.mass, heavy.mass)


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
