"""Linkages as data: existence factors, coordinates, copies."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj

SHAPES = dict(
    ef=(6,), length=(4,), com=(3, 2), mass=(3,), inertia=(3,), locked=(3,),
    base_angle=(), gravity=(),
)  # fmt: skip


def make(topology="RRR", **changes):
    arguments = dict(
        length=[0.5, 1, 1.2, 0.8], com=[[0.4, 0.1], [0.6, -0.2], [0.3, 0.1]],
        mass=[2, 1.5, 1], inertia=[0.2, 0.1, 0.3], locked=[0.1, 0.7, -0.4],
        base_angle=0.3,
    )  # fmt: skip
    return fj.Linkage(topology, **arguments | changes)


def test_existence_factors_spell_the_topology_and_stand_for_its_name():
    for topology in fj.TOPOLOGIES:
        ef = np.asarray(fj.existence_factors(topology))
        assert ef[1::2].tolist() == [joint == "R" for joint in topology]
        assert ef[::2].tolist() == [joint == "P" for joint in topology]
        for given in ([int(f) for f in ef], tuple(ef), ef, jnp.array(ef)):
            jax.tree.map(np.testing.assert_array_equal, make(given), make(topology))


def test_every_field_is_an_array_leaf_of_the_default_float_type():
    linkage = make(length=[0, 1, 2, 3], locked=0)
    for name, shape in SHAPES.items():
        value = getattr(linkage, name)
        assert value.shape == shape and value.dtype == jnp.result_type(float), name
        assert not value.weak_type, name  # a weak type would compile once more
    assert len(jax.tree.leaves(linkage)) == len(SHAPES)
    assert linkage.locked.tolist() == [0, 0, 0]
    assert float(linkage.gravity) == 9.81  # by default


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_chain_coordinates_written_out_and_their_inverse(topology):
    rng = np.random.default_rng(1)
    linkage, (q, qd) = random_linkage(topology, rng), rng.normal(size=(2, 3))
    x, xd = fj.paper.to_chain(linkage, q, qd)
    angle, rate, expected = float(linkage.base_angle), 0.0, []
    for k, joint in enumerate(topology):
        slide, slide_rate = float(linkage.locked[k]), 0.0
        if joint == "R":
            angle, rate = angle + q[k], rate + qd[k]
        else:
            angle, slide, slide_rate = angle + slide, q[k], qd[k]
        expected += [[slide, slide_rate], [angle, rate]]
    np.testing.assert_allclose(np.stack([x, xd], axis=1), expected, atol=1e-14)
    for given in (topology, linkage.ef):
        of = partial(fj.paper.from_chain, given, base_angle=linkage.base_angle)
        for locked, state in (of(x, xd), jax.jit(of)(x, xd)):
            np.testing.assert_allclose(locked, linkage.locked, atol=1e-13)
            np.testing.assert_allclose(state, (q, qd), atol=1e-13)


@pytest.mark.parametrize(
    "place, words", [(slice(1), "B1 rate"), (slice(3, 6, 2), "th3")]
)
def test_from_chain_refuses_velocities_of_locked_joints(place, words):
    x, xd = map(np.array, fj.paper.to_chain(make("RPR"), np.ones(3), np.ones(3)))
    xd[place] += 1e-6  # of a slide, or of this and all later links, which turn on
    with pytest.raises(ValueError, match=rf"^xd: expected {words}.*, got .*1e-06"):
        fj.paper.from_chain("RPR", x, xd, 0.3)


def test_traced_values_are_not_checked():
    """One program builds linkages of any topology and any masses."""
    build = jax.jit(lambda ef, mass: make(ef, mass=mass * jnp.ones(3)))
    for topology, mass in zip(fj.TOPOLOGIES, [1.0, -1.0, np.nan, np.inf, 0.0]):
        ef = fj.existence_factors(topology)
        linkage = build(ef, mass)
        np.testing.assert_array_equal(linkage.mass, [mass] * 3)
        np.testing.assert_array_equal(linkage.ef, ef)
    assert build._cache_size() == 1


@pytest.mark.parametrize("name", ["topology", *(n for n in SHAPES if n != "ef")])
def test_traced_shapes_are_checked(name):
    """And values that are known beside them."""
    with pytest.raises(ValueError, match=rf"^{name}: expected .*, got "):
        jax.jit(lambda v: make(**{name: v}))(jnp.ones((2, 5)))
    with pytest.raises(ValueError, match="^mass: expected .*, got"):
        jax.jit(lambda length: make(length=length, mass=[1, -1, 1]))(jnp.ones(4))


def test_a_copy_has_other_values_and_is_checked_as_a_new_one():
    arm = fj.scenes.fig7().linkage
    heavy = arm.replace(mass=[1, 2, 3], topology="RRP")
    np.testing.assert_array_equal(heavy.mass, [1, 2, 3])
    np.testing.assert_array_equal(heavy.ef, fj.existence_factors("RRP"))
    np.testing.assert_array_equal(heavy.length, arm.length)
    copied = arm.__replace__(mass=[1, 2, 3])  # by `copy.replace`, from Python 3.13
    np.testing.assert_array_equal(copied.mass, heavy.mass)
    words = r"^masses: expected an argument of Linkage \(topology, length,"
    with pytest.raises(ValueError, match=words):
        arm.replace(masses=1)
    with pytest.raises(ValueError, match="^mass: expected .* at least 0, got"):
        arm.replace(mass=[-1, 1, 1])
