"""Curves show the right numbers, labels and units; energies add up."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from chains import random_chain
from elements import ALL
from figures import (
    LINKAGE,
    labels,
    lines,
    made_up,
    make_linkage,
    named,
    same,
    swinging,
    tidy as tidy,
    tops,
    values,
)

import fdof_jax as fj
from fdof_jax import drawing, plotting
from fdof_jax.forces import JointFriction, JointStops, Payload

TASK = fj.CircleTask([1, 1], 0.5, 2.0, 0.0)
RPR = make_linkage("RPR")


def dashed(ax):
    (line,) = [line for line in ax.lines if line.get_linestyle() == "--"][:1]
    return line.get_data()


# Motions


def test_motion_profile_shows_joints_and_references():
    solution, start = swinging(), np.array([0.1, 0.2, 0.3])
    step = fj.references.Step(start, start + 0.1, begin=0.505)
    forces = (fj.control.FirstOrderLag(fj.PDController(9, 1, 1, step), 0.1),)
    fig = plotting.motion_profile(RPR, solution, forces=forces, title="An arm")
    angles, slides = fig.axes
    ylabels = angles.get_ylabel(), slides.get_ylabel()
    assert ylabels == ("angle [degrees]", "slide [m]")
    assert slides.get_xlabel() == "time [s]" and fig.get_suptitle() == "An arm"
    assert labels(angles) == ["R1", "R3", "reference"]
    assert labels(slides) == ["P2", "reference"]
    q = np.asarray(solution.q)
    np.testing.assert_allclose(values(angles)[0], np.rad2deg(q[:, 0]))
    np.testing.assert_allclose(values(slides)[0], q[:, 1])
    # A reference that jumps between samples is upright.
    ts, wanted = dashed(slides)
    np.testing.assert_allclose(wanted, np.where(ts < 0.505, 0.2, 0.3))
    (k,) = np.flatnonzero(np.diff(wanted))
    assert ts[k + 1] == 0.505 and 0 < ts[k + 1] - ts[k] < 1e-12


def test_motion_profile_shows_absolute_angles_and_what_is_held_once():
    solution = swinging()
    modes = np.zeros(solution.q.shape)
    modes[5:9, [0, 2]] = 1
    held = dataclasses.replace(solution, modes=jnp.asarray(modes))
    angles, slides = plotting.motion_profile(RPR, held, absolute=True).axes
    assert angles.get_ylabel() == "absolute angle [degrees]"
    assert labels(angles) == [r"$\theta_1$", r"$\theta_3$", "held"]
    assert labels(slides) == ["P2"]
    q = np.asarray(solution.q)
    first, thick, third, *_ = values(angles)
    np.testing.assert_allclose(first, np.rad2deg(0.4 + q[:, 0]))
    np.testing.assert_allclose(third, np.rad2deg(0.4 + q[:, 0] + 0.7 + q[:, 2]))
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(thick)), range(5, 9))
    np.testing.assert_array_equal(thick[5:9], first[5:9])
    assert len(plotting.motion_profile(LINKAGE, solution, plt.figure()).axes) == 1


@pytest.mark.slow
def test_a_motion_that_ended_early_says_so_in_every_picture():
    arm, _, forces, _ = fj.scenes.fig7()
    short = eqx.tree_at(lambda s: s.q, swinging(), swinging().q.at[51:].set(jnp.nan))
    text, task = "ended at 0.5 s:\nsuccessful", forces[0].reference
    over_time = [
        *plotting.motion_profile(arm, short).axes,
        plotting.energy_profile(arm, short).axes[0],
        plotting.effort_profile(arm, forces, short).axes[0],
        plotting.energy_stack(arm, (), short),
    ]
    for ax in over_time:
        assert any(text == t.get_text() for t in ax.get_legend().get_texts())
        (line,) = named(ax, "end")
        assert line.get_xdata()[0] == 0.5 and ax.get_xlim()[1] == 1
    assert labels(over_time[-1]) == ["kinetic", "potential", "at the start", text]
    assert f"a, {text}" in labels(plotting.tracking(arm, task, {"a": short}))
    assert text in labels(drawing.chrono_cyclograph(arm, short))
    assert not named(plotting.motion_profile(arm, swinging()).axes[0], "end")


# Efforts

LIMIT = [1e3, 3e2, np.inf]
HOLD = lambda t, linkage: (jnp.zeros(3), jnp.zeros(3))


@pytest.mark.parametrize("kind", ["PD", "PID"])
def test_effort_profile_has_units_limits_and_saturation(kind):
    q = np.zeros((11, 3))
    q[:5, 1] = 0.1  # beyond the 0.03 m that saturate
    controller, own = fj.PDController(1e4, 0, LIMIT, HOLD), ()
    if kind == "PID":
        controller = fj.control.PIDController(1e4, 1, 0, LIMIT, HOLD)
        own = (np.zeros((11, 3)),)
    forces = controller, fj.JointDamper(1.0)
    # The limits are those of the controller, not of what the damper adds.
    solution = made_up(np.linspace(0, 1, 11), q, np.ones((11, 3)))
    fig = plotting.effort_profile(RPR, forces, dataclasses.replace(solution, own=own))
    names = [ax.get_ylabel() for ax in fig.axes]
    assert names == ["R1 [N m]\nlimit ±1000", "P2 [N]\nlimit ±300", "R3 [N m]"]
    dots = [named(ax, f"saturated {k + 1}") for k, ax in enumerate(fig.axes)]
    assert len(dots[0][0].get_xydata()) == 0 and not dots[2]
    np.testing.assert_allclose(dots[1][0].get_ydata(), np.full(5, -300.0))
    assert [len(ax.patches) for ax in fig.axes] == [0, 1, 0]  # where limits are near
    low, high = fig.axes[1].get_ylim()
    assert low < -300 and high > 300
    shown = [f"{kind}Controller", "JointDamper", "limits", "saturated"]
    assert sorted(labels(fig.axes[0])) == sorted(shown)
    own, damped = values(fig.axes[1])[:2]
    np.testing.assert_allclose(damped, -1)
    np.testing.assert_array_equal(own[:5], -300)


def test_effort_profile_shows_a_short_start_larger():
    ts, q = np.linspace(0, 10, 1001), np.zeros((1001, 3))
    q[:, 1] = np.exp(-5 * ts) * np.cos(30 * ts)
    forces = (fj.PDController(1e3, 0, 300, HOLD),)
    fig = plotting.effort_profile(RPR, forces, made_up(ts, q))
    start, whole = np.reshape(fig.axes, (3, 2)).T
    assert 0.2 < start[1].get_xlim()[1] < 1.5 and whole[1].get_xlim()[1] > 9
    assert start[1].get_ylim() == whole[1].get_ylim()
    np.testing.assert_array_equal(values(start[1])[0], values(whole[1])[0])


# Tracking


def test_tracking_and_its_error():
    for times in (1, 2):  # the legend takes as many rows as it needs
        long = {times * name: swinging() for name in ("paper gains", "tuned gains")}
        ax = plotting.tracking(LINKAGE, TASK, long)
        assert ax.get_legend().get_window_extent().x1 <= ax.figure.bbox.x1
        assert len(labels(ax)) == 3
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

    ax = plotting.tracking_by_error(LINKAGE, TASK, swinging())
    assert labels(ax) == ["start", "commanded"]
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


@pytest.mark.slow
def test_chains_of_any_length_show_all_joints_that_move():
    chain = random_chain("RFPRR", np.random.default_rng(5))
    motion = made_up(np.linspace(0, 1, 3), np.linspace(0.2, 1, 3)[:, None] * np.ones(5))
    curves = lambda fig: [len(ax.lines) for ax in fig.axes]
    assert sum(curves(plotting.motion_profile(chain, motion))) == 4
    forces = (fj.JointDamper(np.ones(5)),)
    assert sum(curves(plotting.effort_profile(chain, forces, motion))) == 4
    assert curves(plotting.energy_profile(chain, motion)) == [5, 5, 3]
    tip = fj.tip_position(chain, motion.q[0])
    same(lines(drawing.draw_linkage(chain, motion.q[0]))["tip 5"], [tip])


# Energies


def stack_of(linkage, forces, solution):
    """Returns the edges of an energy stack by name, and its dashed line."""
    ax = plotting.energy_stack(linkage, forces, solution)
    return tops(ax, solution.ts), values(ax)[0], labels(ax)


def test_energy_profile_adds_up():
    fig = plotting.energy_profile(make_linkage("PRR"), swinging())
    kinetic, potential, whole = fig.axes
    assert all("[J]" in ax.get_ylabel() for ax in fig.axes)
    assert labels(kinetic) == ["link 1", "link 2", "link 3"]
    assert labels(whole) == ["kinetic", "potential", "total"]
    sums = [sum(values(ax)) for ax in (kinetic, potential)]
    for total, expected in zip(values(whole), (*sums, sums[0] + sums[1])):
        np.testing.assert_allclose(total, expected, atol=1e-12)


LIFT = fj.Linkage(
    "P", length=[0.3, 1], com=[[0.5, 0.1]], mass=[4], inertia=[0.1], base_angle=0.4
)
MASS, DAMPING, STIFFNESS = 4.0, 3.0, 50.0


def lifted(effort, end=2.0):
    """Returns an exact motion: the slide on a damped stop under an effort."""
    stops = JointStops(0, np.inf, stiffness=STIFFNESS)
    rest = (effort - MASS * 9.81 * np.cos(0.4)) / STIFFNESS
    rate = np.roots([MASS, DAMPING, STIFFNESS])[0]
    swing = 0.2 * (1 + 1j * rate.real / rate.imag)  # starts with no speed
    ts, (q, qd) = np.linspace(0, end, 401), np.zeros((2, 401, 1))
    q[:, 0] = rest + np.real(swing * np.exp(rate * ts))
    qd[:, 0] = np.real(rate * swing * np.exp(rate * ts))
    forces = fj.JointDamper(DAMPING), stops, fj.JointEffort([effort])
    return forces, made_up(ts, q, qd)


@pytest.mark.slow
def test_energy_stack_keeps_its_top_where_energy_is_only_taken_out():
    forces, solution = lifted(0.0)
    stack, line, names = stack_of(LIFT, forces, solution)
    assert names == ["kinetic", "potential", "taken out", "at the start"]
    top = stack["taken out"]
    np.testing.assert_allclose(line, line[0], rtol=1e-9)
    np.testing.assert_allclose(top, line, rtol=1e-4)
    kinetic = MASS * np.asarray(solution.qd)[:, 0] ** 2 / 2
    np.testing.assert_allclose(stack["kinetic"], kinetic, atol=1e-12)
    potential = stack["potential"] - stack["kinetic"]
    assert potential.min() == 0 and potential.max() > 0.5
    taken = top - stack["potential"]
    assert taken[0] == 0 and taken[-1] > 0.5 and np.diff(taken).min() > -1e-9
    # The trapezoidal rule is of the second order.
    coarse = stack_of(LIFT, *lifted(0.0, 4.0))[0]["taken out"]
    worse = np.abs(coarse - line[0]).max() / np.abs(top - line[0]).max()
    assert 2**2 / 1.5 < worse < 2**2 * 1.5
    # An effort drives and brakes.
    forces, solution = lifted(20.0)
    stack, line, names = stack_of(LIFT, forces, solution)
    assert names[-1] == "start + put in"
    np.testing.assert_allclose(stack["taken out"], line, rtol=1e-5)
    steps = np.diff(solution.q[:, 0])
    put_in = 20 * np.maximum(steps, 0).sum()
    assert steps.min() < 0
    np.testing.assert_allclose(line[-1] - line[0], put_in, rtol=1e-3)


@pytest.mark.slow
def test_energy_stack_balances_with_elements_of_each_kind():
    """With and without an energy, and with masses; what lacks acts beside them.

    That each element's power is what its energy loses is tested in test_elements.py.
    """
    forces = tuple(ALL[kind] for kind in ("payload", "history", "spring"))
    arm, ts = make_linkage("RPR"), np.linspace(0, 0.3, 301)
    path = lambda t: jnp.stack([jnp.sin(9 * t), 0.3 * jnp.cos(7 * t), 0.5 - t**2])
    rate = jax.jacfwd(path)
    rows = [jax.vmap(f)(ts) for f in (path, rate, jax.jacfwd(rate))]
    needed = jax.vmap(lambda *row: fj.inverse_dynamics(arm, *row, forces[:1]))(*rows)
    solution = made_up(ts, *rows[:2])
    lacking = (needed - fj.joint_efforts(arm, forces, solution).total).T
    rest = lambda t, *_: jnp.stack([jnp.interp(t, ts, row) for row in lacking])
    stack, line, _ = stack_of(arm, (*forces, rest), solution)
    np.testing.assert_allclose(stack["taken out"], line, rtol=1e-4)


SLIDE = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[2], inertia=[1], gravity=0)


@pytest.mark.slow
def test_energy_stack_counts_what_friction_takes_once():
    """Of a slide under sampled efforts that are held, and against two frictions.

    The motion counts what the first takes, but not that of a function.
    """
    plain = lambda t, q, qd, linkage: 2.0
    forces = (lambda *_: 0.0), JointFriction(1.0), JointFriction(plain)
    held = np.where(np.arange(11) < 5, 9.0, -5.0)  # it slows down, but goes on
    qd = np.append(1, 1 + 0.05 * (held[:-1] - 3).cumsum())
    q = np.append(0, 0.05 * (qd[1:] + qd[:-1]).cumsum())
    solution = dataclasses.replace(
        made_up(np.linspace(0, 1, 11), q[:, None], qd[:, None]),
        taken=jnp.asarray(q), tau=held[:, None], acting=held[:, None],
    )  # fmt: skip
    stack, line, _ = stack_of(SLIDE, forces, solution)
    np.testing.assert_allclose(line[-1], 1 + 9 * q[5], rtol=1e-9)
    out = stack["taken out"] - stack["potential"]
    np.testing.assert_allclose(out, 3 * q + 5 * np.maximum(q - q[5], 0), atol=1e-9)


@pytest.mark.slow
def test_energy_stack_has_what_payloads_bring_and_take_away():
    """Of a slide of 2 kg and 1 m/s, which catches 3 kg of 2 m/s and lets them go."""
    ts, momentum = np.linspace(0, 1, 11), 2 * 1 + 3 * 2
    caught, gone = ts >= 0.3, ts >= 0.7
    qd = np.where(caught, momentum / 5, 1.0)
    q = np.where(caught, 0.3 + momentum / 5 * (ts - 0.3), ts)
    before, after = 2 * 1**2 / 2 + 3 * 2**2 / 2, momentum**2 / 5 / 2
    solution = dataclasses.replace(
        made_up(ts, q[:, None], qd[:, None]),
        taken=jnp.asarray((before - after) * caught),
    )
    load = Payload(fj.Point(1, 1), 3.0, begin=0.3, end=0.7, velocity=[2.0, 0.0])
    stack, line, _ = stack_of(SLIDE, (load,), solution)
    np.testing.assert_allclose(stack["taken out"], line, rtol=1e-9)
    # The slide has its own energy at first, then that of the load as well.
    brought, leaves = 3 * 2**2 / 2, 3 * (momentum / 5) ** 2 / 2
    np.testing.assert_allclose(line, np.where(caught, 1 + brought, 1), rtol=1e-9)
    out = stack["taken out"] - stack["potential"]
    np.testing.assert_allclose(
        out, (before - after) * caught + leaves * gone, atol=1e-9
    )
