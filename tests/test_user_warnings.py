"""Warnings and refusals that name the caller's line, or the way to go."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.linkage.coordinates import real_state

ARM = fj.scenes.fig7().linkage  # RPR


@pytest.mark.parametrize(
    "name, given",
    [
        ("state0.q", lambda: real_state("state0", ([0, 2, 90], np.zeros(3)), ARM)),
        ("base_angle", lambda: ARM.replace(base_angle=-45)),
        ("orientation", lambda: fj.inverse_kinematics(ARM, [-4, 2], 30.0)),
        ("phase", lambda: fj.CircleTask(phase=180)),
        ("tilt", lambda: fj.references.Ellipse([1, 1], [0.4, 0.2], tilt=45)),
    ],
)
def test_what_looks_like_degrees(name, given):
    with pytest.warns(
        UserWarning, match=rf"^{name}: .* radians, got -?\d+, .*deg2rad"
    ) as w:
        try:
            given()
        except ValueError:  # out of reach in that direction
            pass
    assert {warning.filename for warning in w} == {__file__}


def test_other_angles_are_taken_as_they_are():
    for q in ([29.0, 45, 100.3], [-12 * np.pi, 90, 375.0]):  # the slide may be long
        real_state("state0", (q, np.zeros(3)), ARM)
    jax.jit(lambda q: real_state("state0", (q, q), ARM))(jnp.full(3, 90.0))


def test_a_warning_within_a_transformation_names_the_line():
    moved = lambda q: fj.tip_position(ARM.replace(base_angle=90), q)
    with pytest.warns(UserWarning, match="^base_angle") as caught:
        jax.vmap(moved)(jnp.zeros((2, 3)))
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    "changed, name, way",
    [
        (ARM, "mass", r"linkage\.replace\(mass=\.\.\.\)"),
        (fj.JointDamper(1.0), "coefficient", r"equinox\.tree_at\(lambda it: it\.coeff"),
        (fj.CircleTask(), "radius", r"equinox\.tree_at\(lambda it: it\.radius, it, "),
    ],
)
def test_an_assignment_names_the_way(changed, name, way):
    with pytest.raises(dataclasses.FrozenInstanceError, match=f"^{name}: .* {way}"):
        setattr(changed, name, 1)


def test_a_point_can_be_replaced():
    moved = dataclasses.replace(fj.Point(1, 0.5), along=0.7)
    assert (int(moved.link), float(moved.along)) == (1, 0.7)
