"""Curves show the right numbers, labels and units; pixels are not compared."""

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from chains import random_chain
from figures import (
    LINKAGE,
    labels,
    lines,
    made_up,
    make_linkage,
    named,
    swinging,
    tidy as tidy,
    values,
)

import fdof_jax as fj
from fdof_jax import drawing, plotting

TASK = fj.CircleTask([1, 1], 0.5, 2.0, 0.0)


def test_motion_profile_shows_joints_by_their_names():
    fig = plotting.motion_profile(make_linkage("RPR"), swinging(), title="An arm")
    angles, slides = fig.axes
    assert angles.get_ylabel() == "angle [degrees]"
    assert labels(angles) == ["R1", "R3"] and labels(slides) == ["P2"]
    q = np.asarray(swinging().q)
    np.testing.assert_allclose(values(angles), np.rad2deg(q[:, [0, 2]].T))
    assert fig.get_suptitle() == "An arm"


def test_motion_profile_shows_references():
    solution, start = swinging(), np.array([0.1, 0.2, 0.3])
    step = fj.references.Step(start, start + 0.1, begin=0.5)
    forces = (fj.control.FirstOrderLag(fj.PDController(9, 1, 1, step), 0.1),)
    fig = plotting.motion_profile(make_linkage("RPR"), solution, forces=forces)
    angles, slides = fig.axes
    assert labels(angles) == ["R1", "R3", "reference"]
    dashed = [line for line in slides.lines if line.get_linestyle() == "--"]
    ts, wanted = dashed[0].get_data()
    np.testing.assert_allclose(wanted, np.where(ts < 0.5, 0.2, 0.3))


def test_a_reference_that_jumps_between_samples_is_drawn_upright():
    step = fj.references.Step([0.0, 1.0, 0.5], [1.0, 1.0, 0.0], begin=0.33)
    forces = (fj.PDController(1.0, 0.0, 1.0, step),)
    angles, _ = plotting.motion_profile(
        make_linkage("RPR"), swinging(5), forces=forces
    ).axes
    dashed = [line for line in angles.lines if line.get_linestyle() == "--"][0]
    ts, wanted = dashed.get_data()
    moves = np.flatnonzero(np.diff(wanted))
    assert len(moves) == 1 and ts[moves[0] + 1] == 0.33
    assert 0 < ts[moves[0] + 1] - ts[moves[0]] < 1e-12


@pytest.mark.slow
def test_a_motion_that_ended_early_says_so_in_every_picture():
    scene = fj.scenes.fig7()
    arm, _, forces, _ = scene
    ts = np.linspace(0, 2, 401)
    short = fj.simulate(scene, ts, max_steps=60, throw=False)
    last = ts[np.isfinite(short.q[:, 0])][-1]
    text = f"ended at {last:.3g} s:\nout of steps"
    task = forces[0].reference
    over_time = [
        *plotting.motion_profile(arm, short).axes,
        plotting.energy_profile(arm, short).axes[0],
        plotting.effort_profile(arm, forces, short).axes[0],
        plotting.energy_stack(arm, forces, short),
    ]
    for ax in over_time:
        assert any(text == t.get_text() for t in ax.get_legend().get_texts())
        (line,) = named(ax, "end")
        assert line.get_xdata()[0] == last and ax.get_xlim()[1] == 2
    assert f"a, {text}" in labels(plotting.tracking(arm, task, {"a": short}))
    assert text in labels(drawing.chrono_cyclograph(arm, short))
    whole = fj.simulate(scene, ts)
    assert not named(plotting.motion_profile(arm, whole).axes[0], "end")


def test_motion_profile_shows_absolute_angles_in_degrees_and_slides():
    solution = swinging()
    fig = plotting.motion_profile(make_linkage("RPR"), solution, absolute=True)
    angles, slides = fig.axes
    assert angles.get_ylabel() == "absolute angle [degrees]"
    assert slides.get_ylabel() == "slide [m]"
    assert slides.get_xlabel() == "time [s]"
    assert labels(angles) == [r"$\theta_1$", r"$\theta_3$"]
    assert labels(slides) == ["P2"]
    q = np.asarray(solution.q)
    th1, th3 = values(angles)
    np.testing.assert_allclose(th1, np.rad2deg(0.4 + q[:, 0]))
    np.testing.assert_allclose(th3, np.rad2deg(0.4 + q[:, 0] + 0.7 + q[:, 2]))
    np.testing.assert_allclose(values(slides)[0], q[:, 1])
    only = plotting.motion_profile(make_linkage("RRR"), solution, plt.figure())
    assert len(only.axes) == 1


def test_motion_profile_names_what_is_held_once():
    solution = swinging()
    modes = np.zeros(solution.q.shape)
    modes[5:9, [0, 2]] = 1
    held = dataclasses.replace(solution, modes=jnp.asarray(modes))
    angles, slides = plotting.motion_profile(make_linkage("RPR"), held).axes
    assert labels(angles) == ["R1", "R3", "held"]
    assert labels(slides) == ["P2"]
    line, thick, *_ = values(angles)
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(thick)), range(5, 9))
    np.testing.assert_array_equal(thick[5:9], line[5:9])


def hold(t, linkage):
    return jnp.zeros(3), jnp.zeros(3)


LIMIT = [1e3, 3e2, np.inf]


@pytest.mark.parametrize("kind", ["PD", "PID"])
def test_effort_profile_has_units_limits_and_saturation(kind):
    q = np.zeros((11, 3))
    q[:5, 1] = 0.1  # beyond the 0.03 m that saturate
    controller, own = fj.PDController(1e4, 0, LIMIT, hold), ()
    if kind == "PID":
        controller = fj.control.PIDController(1e4, 1, 0, LIMIT, hold)
        own = (np.zeros((11, 3)),)
    forces = controller, fj.JointDamper(1.0)
    solution = dataclasses.replace(made_up(np.linspace(0, 1, 11), q), own=own)
    fig = plotting.effort_profile(make_linkage("RPR"), forces, solution)
    names = [ax.get_ylabel() for ax in fig.axes]
    assert names == ["R1 [N m]\nlimit ±1000", "P2 [N]\nlimit ±300", "R3 [N m]"]
    dots = [named(ax, f"saturated {k + 1}") for k, ax in enumerate(fig.axes)]
    assert len(dots[0][0].get_xydata()) == 0 and not dots[2]
    np.testing.assert_allclose(dots[1][0].get_ydata(), np.full(5, -300.0))
    assert [len(ax.patches) for ax in fig.axes] == [0, 1, 0]  # where limits are near
    low, high = fig.axes[1].get_ylim()
    assert low < -300 and high > 300
    assert set(labels(fig.axes[0])) == {f"{kind}Controller", "limits", "saturated"}
    # The limits are those of the controller, not of what the damper adds.
    fast = dataclasses.replace(solution, qd=solution.qd + 1)
    fig = plotting.effort_profile(make_linkage("RPR"), forces, fast)
    own, damped = values(fig.axes[1])[:2]
    np.testing.assert_allclose(damped, -1)
    np.testing.assert_array_equal(own[:5], -300)
    assert labels(fig.axes[0])[:2] == [f"{kind}Controller", "JointDamper"]


def test_effort_profile_shows_a_short_start_larger():
    ts, q = np.linspace(0, 10, 1001), np.zeros((1001, 3))
    q[:, 1] = np.exp(-5 * ts) * np.cos(30 * ts)
    solution = made_up(ts, q)
    forces = (fj.PDController(1e3, 0, 300, hold),)
    fig = plotting.effort_profile(make_linkage("RPR"), forces, solution)
    start, whole = np.reshape(fig.axes, (3, 2)).T
    assert 0.2 < start[1].get_xlim()[1] < 1.5 and whole[1].get_xlim()[1] > 9
    assert start[1].get_ylim() == whole[1].get_ylim()
    np.testing.assert_array_equal(values(start[1])[0], values(whole[1])[0])


def test_a_legend_takes_as_many_rows_as_it_needs():
    solutions = {"paper gains": swinging(), "tuned gains": swinging()}
    for words in (solutions, {2 * name: s for name, s in solutions.items()}):
        ax = plotting.tracking(LINKAGE, TASK, words)
        assert ax.get_legend().get_window_extent().x1 <= ax.figure.bbox.x1
        assert len(labels(ax)) == 3


def test_tracking_and_its_error():
    solutions = {"paper": swinging(), "tuned": swinging(51, 0.5)}
    ax = plotting.tracking(LINKAGE, TASK, solutions)
    assert labels(ax) == ["commanded", "paper", "tuned"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    curves = {line.get_label(): np.asarray(line.get_xydata()) for line in ax.lines}
    np.testing.assert_allclose(np.hypot(*(curves["commanded"] - [1, 1]).T), 0.5)
    tips = np.asarray(jax.vmap(lambda q: fj.tip_position(LINKAGE, q))(swinging().q))
    np.testing.assert_allclose(curves["paper"], tips, atol=1e-12)

    error = plotting.tracking_error(LINKAGE, TASK, solutions)
    assert (error.get_xlabel(), error.get_ylabel()) == ("time [s]", "tip error [m]")
    errors = np.hypot(*(tips - curves["commanded"]).T)
    np.testing.assert_allclose(values(error)[0], errors)
    assert len({line.get_color() for line in error.lines}) == 2

    given = plt.subplots()[1]
    ax = plotting.tracking_by_error(LINKAGE, TASK, swinging(), given)
    assert ax is given and labels(ax) == ["start", "commanded"]
    (path,) = ax.collections
    pieces = np.stack([tips[:-1], tips[1:]], axis=1)
    np.testing.assert_allclose(path.get_segments(), pieces, atol=1e-12)
    np.testing.assert_allclose(path.get_array(), 500 * (errors[:-1] + errors[1:]))
    (bar,) = ax.child_axes
    assert bar.get_ylabel() == "tip error [mm]"
    assert bar.get_ylim() == path.get_clim() == pytest.approx((0, 1000 * errors.max()))
    left, right, bottom, top = ax.axis()
    assert ((pieces > [left, bottom]) & (pieces < [right, top])).all()
    lightest = path.cmap(1.0)[:3] @ np.array([0.2126, 0.7152, 0.0722])
    assert lightest < 0.75  # seen on white


def test_tracking_in_the_picture_of_an_arm_has_colours_of_its_own():
    arm = drawing.chrono_cyclograph(LINKAGE, swinging(), until=0.5)
    plotting.tracking(LINKAGE, TASK, {"a": swinging(), "b": swinging(51)}, arm)
    drawn = {line.get_label(): line for line in arm.lines}
    links = {drawn[f"link {k}"].get_color() for k in (1, 2, 3)}
    assert not links & {drawn["a"].get_color(), drawn["b"].get_color()}
    controller = fj.PDController(1, 1, 1, TASK)
    ax = drawing.draw_linkage(LINKAGE, [0, 0, 0], forces=(controller,))
    path, same = drawn["commanded"], lines(ax)["commanded 0"]
    assert path.get_linestyle() == same.get_linestyle() == "--"
    assert path.get_color() == same.get_color()


@pytest.mark.slow
@pytest.mark.parametrize("topology", ["R", "RP", "RFPRR"])
def test_chains_of_any_length_show_all_joints_that_move(topology):
    n, moving = len(topology), len(topology.replace("F", ""))
    chain = random_chain(topology, np.random.default_rng(n))
    motion = made_up(np.linspace(0, 1, 3), np.linspace(0.2, 1, 3)[:, None] * np.ones(n))
    curves = lambda fig: [len(ax.lines) for ax in fig.axes]
    assert sum(curves(plotting.motion_profile(chain, motion))) == moving
    forces = (fj.JointDamper(np.ones(n)),)
    assert sum(curves(plotting.effort_profile(chain, forces, motion))) == moving
    kinetic, potential, _ = curves(plotting.energy_profile(chain, motion))
    assert kinetic == potential == n
    still = drawing.draw_linkage(chain, motion.q[0])
    film = drawing.animate(chain, motion)
    film._init_draw()  # the first frame
    tip = np.asarray(fj.tip_position(chain, motion.q[0]))
    for ax in (still, film._fig.axes[0]):  # type: ignore[attr-defined]
        points = np.concatenate([line.get_xydata() for line in ax.lines])
        assert np.nanmin(np.linalg.norm(points - tip, axis=1)) < 1e-9
