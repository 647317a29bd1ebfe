"""Malformed references are refused, and paths out of reach."""

import re
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_bad_input import LINKAGE, ZERO, controller, make, refused, simulate

import fdof_jax as fj


def test_period_zero_is_refused():
    refused("period", lambda: fj.CircleTask(period=0))


@pytest.mark.parametrize("branch", [0, 2, -1.5, "1", None, True, np.nan, [1]], ids=repr)
def test_branches_other_than_plus_and_minus_one_are_refused(branch):
    refused("branch", lambda: fj.CircleTask(branch=branch))
    refused(
        "branch", lambda: fj.inverse_kinematics(LINKAGE, [1, 1], 0.0, branch=branch)
    )


@pytest.mark.parametrize("branch", [1, -1.0, np.int64(-1), np.float32(1), jnp.array(1)])
def test_numbers_of_any_kind_name_a_branch(branch):
    assert fj.CircleTask(branch=branch).branch == float(branch)
    fj.inverse_kinematics(LINKAGE, [1, 1], 0.0, branch=branch)


@pytest.mark.parametrize("value", [None, 3.0, (ZERO, ZERO), fj.CircleTask])
def test_references_that_cannot_be_called_are_refused(value):
    refused("reference", lambda: controller(reference=value))


@pytest.mark.parametrize(
    "returned",
    [None, ZERO, (np.zeros(2), np.zeros(2)), (ZERO, None)] + [(ZERO * 1j, ZERO)],
    ids=repr,
)
def test_references_that_return_no_motion_are_refused(returned):
    element = controller(reference=lambda t, linkage: returned)
    refused("reference", lambda: element(0.0, jnp.zeros(3), jnp.zeros(3), LINKAGE))
    place = r"forces\[1\]\."
    for _ in range(3):  # by itself, in a drive, and in a drive of a drive
        forces = fj.JointDamper(1.0), element
        refused(f"{place}reference", partial(simulate, forces=forces))
        place += r"command\."
        element = fj.control.FirstOrderLag(element, 0.1)


@pytest.mark.parametrize("circle", [dict(center=[9, 9]), dict(radius=5.0)], ids=str)
def test_circles_out_of_reach_are_refused_at_the_door(circle):
    scene = fj.scenes.fig7()
    forces = eqx.tree_at(
        lambda f: f[0].reference, scene.forces, fj.CircleTask(branch=1, **circle)
    )
    if "center" in circle:  # this arm's slide has no end: only too near is out of reach
        scene = scene._replace(linkage=make("RRR"))
    place = r"^forces\[0\]\.reference"
    with pytest.raises(ValueError, match=place + ": expected .* reach .*, got .*"):
        fj.simulate(scene.linkage, scene.state0, [0, 5.0], forces)
    drives = (fj.control.FirstOrderLag(forces[0], 0.1),)
    with pytest.raises(ValueError, match=r"^forces\[0\]\.command\.reference: expected"):
        fj.simulate(scene.linkage, scene.state0, [0, 5.0], drives)


@pytest.mark.parametrize(
    "task, words",
    [
        (fj.CircleTask([9, 9], radius=0, orientation=0.5), "at orientation 0.5 rad on"),
        (
            fj.TipTask(fj.references.Line([1, 1], [9, 9]), lambda t: t, branch=-1),
            "at orientation 0 rad on branch -1",
        ),
    ],
    ids=["circle", "line"],
)
def test_what_a_task_commands_out_of_reach_is_refused_or_nan(task, words):
    arm = make("RRR")
    place = re.escape("[9.0, 9.0] m.")
    message = f"^t: expected .* reach {words}.*, got 1 s, at which .* {place}$"
    with pytest.raises(ValueError, match=message):
        task(1.0, arm)
    assert np.isnan(jax.jit(lambda t: task(t, arm))(1.0)).any()


def test_points_out_of_reach_are_refused():
    with pytest.raises(ValueError, match=r"^tip: expected .* reach .*, got \[9"):
        fj.inverse_kinematics(LINKAGE, [9, 9], 0.0)


def test_paths_that_begin_at_the_edge_of_the_reach_are_refused():
    """The joints' velocities are not finite there."""
    length, com = [0, 1, 1, 1], [[0.5, 0]] * 3
    arm = fj.Linkage("RRR", length=length, com=com, mass=[1] * 3, inertia=[1] * 3)
    line, travel = fj.references.Line([3, 0], [1, 1]), fj.references.Travel(1.0)
    with pytest.raises(ValueError, match="reference: .* that leaves it at 0 s"):
        fj.TipTask(line, travel, orientation=0.0).check(arm, np.array([0.0, 1.0]))


def test_circles_are_refused_for_their_nearest_point_alone():
    arm = fj.Linkage(
        "RRR", length=[0, 1, 0.6, 0.3], com=[[0, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
    )
    ts = np.array([0.0, 5.0])
    # The wrist comes within 0.4 m of the base, between samples of the circle.
    circle = lambda radius: fj.CircleTask([1.2, 0], radius, 5.0, np.pi / 256, 0.0)
    circle(0.5 - 1e-7).check(arm, ts)
    with pytest.raises(ValueError, match="reference: expected a circle within"):
        circle(0.5 + 1e-7).check(arm, ts)
