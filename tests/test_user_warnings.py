"""Warnings and refusals that name the caller's line, or the way to go."""

import dataclasses
import warnings
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.base.user_warnings import warn, without_warning
from fdof_jax.forces.element import elements_on
from fdof_jax.linkage.coordinates import real_state

ARM = fj.scenes.fig7().linkage  # RPR
# Of the slide 45 m are no angle.
STOPS = fj.forces.JointStops([-1, -45, -np.inf], [1, 45, 90])
MOVE = fj.references.JointMove([0, 45, 0], [90, 45, 0], fj.references.Travel(1.0))
MOVED = fj.PDController(1.0, 1.0, 1.0, MOVE)


@pytest.mark.parametrize(
    "name, given",
    [
        ("state0.q", lambda: real_state("state0", ([0, 2, 90], np.zeros(3)), ARM)),
        ("base_angle", lambda: ARM.replace(base_angle=-45)),
        ("orientation", lambda: fj.inverse_kinematics(ARM, [-4, 2], 30.0)),
        ("phase", lambda: fj.CircleTask(phase=180)),
        ("tilt", lambda: fj.references.Ellipse([1, 1], [0.4, 0.2], tilt=45)),
        ("locked", lambda: ARM.replace(locked=[0, 90, 0])),
        ("q", lambda: fj.drawing.draw_linkage(ARM, [0, 2, 90])),
        (r"forces\[0\]\.upper", lambda: elements_on(ARM, (STOPS,))),
        (r"forces\[0\]\.reference\.end", lambda: elements_on(ARM, (MOVED,))),
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
        plt.close("all")
    assert {warning.filename for warning in w} == {__file__}


def test_other_angles_are_taken_as_they_are():
    for q in ([29.0, 45, 100.3], [-12 * np.pi, 90, 375.0]):  # the slide may be long
        real_state("state0", (q, np.zeros(3)), ARM)
    ARM.replace(locked=[45.0, 0, 30])  # of revolute joints [m]
    jax.jit(lambda q: real_state("state0", (q, q), ARM))(jnp.full(3, 90.0))


def test_a_warning_within_a_transformation_names_the_line():
    moved = lambda q: fj.tip_position(ARM.replace(base_angle=90), q)
    with pytest.warns(UserWarning, match="^base_angle") as caught:
        jax.vmap(moved)(jnp.zeros((2, 3)))
    assert caught[0].filename == __file__


def test_an_assignment_names_the_way():
    for value, name in ((ARM, "mass"), (fj.JointDamper(1.0), "coefficient")):
        way = rf"^{name}: .* its replace\({name}=\.\.\.\)"
        with pytest.raises(dataclasses.FrozenInstanceError, match=way):
            setattr(value, name, 1)
    moved = dataclasses.replace(fj.Point(1, 0.5), along=0.7)
    assert (int(moved.link), float(moved.along)) == (1, 0.7)


def test_what_is_older_than_double_precision():
    early = lambda tree: jax.tree.map(lambda leaf: leaf.astype(jnp.float32), tree)
    damper = fj.JointDamper([1.0, 1.0, 1.0])
    solve = lambda *scene: jax.eval_shape(
        lambda q: fj.simulate(scene[0], (q, q), [0, 1], scene[1:]).q, jnp.zeros(3)
    )
    for name, scene in (
        ("linkage", (early(ARM), damper)),
        (r"forces\[0\]", (ARM, early(damper))),
    ):
        with pytest.warns(UserWarning, match=f"^{name}: .* in float32") as caught:
            solve(*scene)
        assert [warning.filename for warning in caught] == [__file__]


def test_a_warning_is_omitted_in_one_thread_alone():
    with warnings.catch_warnings(record=True) as caught, ThreadPoolExecutor(1) as other:
        warnings.simplefilter("always")
        with without_warning("joint 2"):
            warn("joint 2 is here")
            warn("joint 3 is here")
            other.submit(warn, "joint 2 is there").result()
        warn("joint 2 is here again")
    said = [str(one.message) for one in caught]
    assert said == ["joint 3 is here", "joint 2 is there", "joint 2 is here again"]
