"""Curves show the right numbers, labels and units; pixels are not compared."""

import dataclasses

import elements
import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from test_drawing import (
    BATCH,
    LINKAGE,
    NOWHERE,
    SOLUTION,
    labels,
    lines,
    made_up,
    make_linkage,
    named,
    swinging,
    tidy as tidy,
)

from fdof_jax import (
    CircleTask,
    JointDamper,
    JointEffort,
    PDController,
    Solution,
    drawing,
    plotting,
    simulate,
    tip_position,
)
from fdof_jax.control import PIDController
from fdof_jax.forces import JointStops


def values(ax: Axes) -> list[np.ndarray]:
    return [np.asarray(line.get_ydata()) for line in ax.lines]


def test_motion_profile_shows_absolute_angles_in_degrees_and_slides():
    solution = swinging()
    fig = plotting.motion_profile(make_linkage("RPR"), solution)
    angles, slides = fig.axes
    assert angles.get_ylabel() == "absolute angle [degrees]"
    assert slides.get_ylabel() == "slide [m]"
    assert slides.get_xlabel() == "time [s]"
    assert labels(angles) == [r"$\theta_1$", r"$\theta_3$"]
    assert labels(slides) == ["$B_2$"]
    q = np.asarray(solution.q)
    th1, th3 = values(angles)
    np.testing.assert_allclose(th1, np.rad2deg(0.4 + q[:, 0]))
    np.testing.assert_allclose(th3, np.rad2deg(0.4 + q[:, 0] + 0.7 + q[:, 2]))
    np.testing.assert_allclose(values(slides)[0], q[:, 1])
    only = plotting.motion_profile(make_linkage("RRR"), solution, plt.figure())
    assert len(only.axes) == 1


def test_energy_profile_adds_up():
    fig = plotting.energy_profile(make_linkage("PRR"), swinging())
    kinetic, potential, whole = fig.axes
    assert all("[J]" in ax.get_ylabel() for ax in fig.axes)
    assert labels(kinetic) == ["link 1", "link 2", "link 3"]
    assert labels(whole) == ["kinetic", "potential", "total"]
    sums = [sum(values(ax)) for ax in (kinetic, potential)]
    for total, expected in zip(values(whole), (*sums, sums[0] + sums[1])):
        np.testing.assert_allclose(total, expected, atol=1e-12)


def tops(ax: Axes, ts) -> dict[str, np.ndarray]:
    """Returns the upper edge of each band of a stack."""
    found = {}
    for band in ax.collections:
        x, y = band.get_paths()[0].vertices.T
        found[band.get_label()] = np.array([y[x == t].max() for t in ts])
    return found


LIFT = make_linkage("PPR")
MASS, DAMPING, STIFFNESS = 4.0, 3.0, 50.0


def lifted(effort: float, end: float = 2.0) -> tuple[tuple, Solution]:
    """Returns an exact motion: the first slide on a damped stop under an effort.

    The other joints stand still, and all masses move with the slide.
    """
    damper = JointDamper([DAMPING, 0, 0])
    stops = JointStops([0, -np.inf, -np.inf], np.inf, stiffness=STIFFNESS)
    weight = MASS * 9.81 * np.cos(0.4)
    rest = (effort - weight) / STIFFNESS
    rate = np.roots([MASS, DAMPING, STIFFNESS])[0]
    swing = 0.2 * (1 + 1j * rate.real / rate.imag)  # starts with no speed
    ts = np.linspace(0, end, 401)
    q, qd = np.zeros((2, 401, 3))
    q[:, 0] = rest + np.real(swing * np.exp(rate * ts))
    qd[:, 0] = np.real(rate * swing * np.exp(rate * ts))
    return (damper, stops, JointEffort([effort, 0, 0])), made_up(ts, q, qd)


def test_energy_stack_keeps_its_top_where_energy_is_only_taken_out():
    forces, solution = lifted(0.0)
    ax = plotting.energy_stack(LIFT, forces, solution)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time [s]", "energy [J]")
    assert labels(ax) == ["kinetic", "potential", "taken out", "at the start"]
    stack = tops(ax, solution.ts)
    top, (line,) = stack["taken out"], values(ax)
    np.testing.assert_allclose(line, line[0], rtol=1e-12)
    np.testing.assert_allclose(top, line, rtol=1e-7)
    kinetic = MASS * np.asarray(solution.qd)[:, 0] ** 2 / 2
    np.testing.assert_allclose(stack["kinetic"], kinetic, atol=1e-12)
    potential = stack["potential"] - stack["kinetic"]
    assert potential.min() == 0 and potential.max() > 0.5
    taken = top - stack["potential"]
    assert taken[0] == 0 and taken[-1] > 0.5 and np.diff(taken).min() > -1e-9
    # Simpson's rule, of the third order at least, with eight times the distance.
    forces, long = lifted(0.0, 16.0)
    coarse = tops(plotting.energy_stack(LIFT, forces, long), long.ts)["taken out"]
    worse = np.abs(coarse - line[0]).max() / np.abs(top - line[0]).max()
    assert worse > 8**3


def test_energy_stack_rises_by_what_is_put_in():
    forces, solution = lifted(20.0)
    ax = plotting.energy_stack(LIFT, forces, solution)
    assert labels(ax)[-1] == "start + put in"
    top, (line,) = tops(ax, solution.ts)["taken out"], values(ax)
    np.testing.assert_allclose(top, line, rtol=1e-6)
    steps = np.diff(solution.q[:, 0])
    assert steps.min() < 0 < steps.max()  # it drives and brakes
    put_in = 20 * np.maximum(steps, 0).sum()
    np.testing.assert_allclose(line[-1] - line[0], put_in, rtol=1e-3)
    forgotten = (*forces[:2], JointEffort(np.zeros(3)))
    fastest = solution.ts[np.argmax(np.abs(steps))]
    said = rf"off by .* J, .* most at t = {fastest:.4g} s: .*\(try \d+ times as many\)"
    with pytest.warns(UserWarning, match=said):
        plotting.energy_stack(LIFT, forgotten, solution)


def test_energy_stack_of_a_free_arm_and_of_what_was_reached():
    solution = swinging(21)
    solution = eqx.tree_at(lambda s: s.q, solution, solution.q.at[11:].set(jnp.nan))
    with pytest.warns(UserWarning, match="the balance is off by"):  # a made-up motion
        ax = plotting.energy_stack(LINKAGE, (), solution)
    assert labels(ax) == ["kinetic", "potential", "at the start"]
    assert ax.get_xlim() == (0, 0.5)


@pytest.mark.slow
def test_energy_stack_balances_with_elements_of_each_kind():
    """With and without an energy, a state and masses.

    That each element's power is what its energy loses is tested in test_points.py.
    """
    arm, start = elements.arm("RPR"), elements.START
    kinds = "history", "spring", "cable", "stops", "wrench", "motor", "armature"
    forces = tuple(elements.ALL[kind] for kind in (*kinds, "actuator"))
    ts = np.linspace(0, 0.075, 501)
    # One step per sample.
    solution = simulate(arm, start, ts, forces, **elements.SHORT | dict(dt0=ts[1]))
    ax = plotting.energy_stack(arm, forces, solution)
    top, (line,) = tops(ax, solution.ts)["taken out"], values(ax)
    np.testing.assert_allclose(top, line, rtol=1e-5)


def hold(t, linkage):
    return jnp.zeros(3), jnp.zeros(3)


LIMIT = [1e3, 3e2, np.inf]


@pytest.mark.parametrize(
    "controller",
    [PDController(1e4, 0, LIMIT, hold), PIDController(1e4, 1, 0, LIMIT, hold)],
    ids=["PD", "PID"],
)
def test_effort_profile_has_units_limits_and_saturation(controller):
    q = np.zeros((11, 3))
    q[:5, 1] = 0.1  # beyond the 0.03 m that saturate
    forces = controller, JointDamper(1.0)
    own = (np.zeros((11, 3)),) if isinstance(controller, PIDController) else ()
    solution = dataclasses.replace(made_up(np.linspace(0, 1, 11), q), own=own)
    fig = plotting.effort_profile(make_linkage("RPR"), forces, solution)
    names = [ax.get_ylabel() for ax in fig.axes]
    assert names == ["$T_1$ [N m]", "$F_2$ [N]", "$T_3$ [N m]"]
    dots = [named(ax, f"saturated {k + 1}") for k, ax in enumerate(fig.axes)]
    assert len(dots[0][0].get_xydata()) == 0 and not dots[2]
    np.testing.assert_allclose(dots[1][0].get_ydata(), np.full(5, -300.0))
    assert [len(ax.patches) for ax in fig.axes] == [1, 1, 0]
    low, high = fig.axes[1].get_ylim()
    assert low < -300 and high > 300
    assert [text.get_text() for ax in fig.axes for text in ax.texts] == [
        "limit ±1000 N m",
        "limit ±300 N",
    ]
    assert set(labels(fig.axes[0])) == {"total", "limits", "saturated"}


def test_the_limit_is_written_where_no_curve_is():
    q = np.zeros((11, 3))
    q[6:, 1] = 0.1  # a negative effort, late: the lower right corner is taken
    solution = made_up(np.linspace(0, 1, 11), q)
    forces = (PDController(1e3, 0, 300, hold),)
    _, middle, last = plotting.effort_profile(LINKAGE, forces, solution).axes
    assert middle.texts[0].xy == (1, 1) and last.texts[0].xy in [(1, 0), (1, 1)]


def test_a_legend_takes_as_many_rows_as_it_needs():
    solutions = {"paper gains": swinging(), "tuned gains": swinging()}
    task = CircleTask([1, 1], 0.5, 2.0, 0.0)
    for words in (solutions, {2 * name: s for name, s in solutions.items()}):
        ax = plotting.tracking(make_linkage("RRR"), task, words)
        assert ax.get_legend().get_window_extent().x1 <= ax.figure.bbox.x1
        assert len(labels(ax)) == 3


def test_effort_profile_without_elements_is_zero():
    fig = plotting.effort_profile(make_linkage("PRR"), (), swinging())
    assert not any(np.any(values(ax)) for ax in fig.axes)


def test_tracking_and_its_error():
    linkage, task = make_linkage("RRR"), CircleTask([1, 1], 0.5, 2.0, 0.0)
    solutions = {"paper": swinging(), "tuned": swinging(51, 0.5)}
    ax = plotting.tracking(linkage, task, solutions)
    assert labels(ax) == ["commanded", "paper", "tuned"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    curves = {line.get_label(): np.asarray(line.get_xydata()) for line in ax.lines}
    off = np.linalg.norm(curves["commanded"] - [1, 1], axis=1)
    np.testing.assert_allclose(off, 0.5)
    expected = tip_position(linkage, solutions["paper"].q[-1])
    np.testing.assert_allclose(curves["paper"][-1], expected, atol=1e-12)

    arm = drawing.chrono_cyclograph(linkage, solutions["paper"], until=0.5)
    plotting.tracking(linkage, task, solutions, arm)
    assert "tip path" not in labels(arm)  # it is the curve
    color = {line.get_label(): line.get_color() for line in arm.lines}
    links = {color[f"link {k}"] for k in (1, 2, 3)}
    assert not links & {color["paper"], color["tuned"]}
    drawn = drawing.draw_linkage(
        linkage, [0, 0, 0], forces=(PDController(1, 1, 1, task),)
    )
    (path,) = [line for line in arm.lines if line.get_label() == "commanded"]
    same = lines(drawn)["commanded 0"]
    assert path.get_linestyle() == same.get_linestyle() == "--"
    assert path.get_color() == same.get_color()

    error = plotting.tracking_error(linkage, task, solutions)
    assert (error.get_xlabel(), error.get_ylabel()) == ("time [s]", "tip error [m]")
    np.testing.assert_allclose(
        values(error)[0], np.linalg.norm(curves["paper"] - curves["commanded"], axis=1)
    )
    assert len({line.get_color() for line in error.lines}) == 2


def test_tracking_by_error_colours_the_path():
    linkage, task, solution = (
        make_linkage("RRR"),
        CircleTask([1, 1], 0.5, 2.0),
        swinging(),
    )
    given = plt.subplots()[1]
    ax = plotting.tracking_by_error(linkage, task, solution, given)
    assert ax is given and (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    (path,) = (c for c in ax.collections if isinstance(c, LineCollection))
    tips = [tip_position(linkage, q) for q in solution.q]
    pieces = np.stack([tips[:-1], tips[1:]], axis=1)
    np.testing.assert_allclose(path.get_segments(), pieces, atol=1e-12)
    errors = values(plotting.tracking_error(linkage, task, {"a": solution}))[0]
    shown = path.get_array()
    np.testing.assert_allclose(shown, 500 * (errors[:-1] + errors[1:]))
    assert path.get_clim() == (0, 1000 * errors.max())
    (bar,) = ax.child_axes
    assert bar.get_ylabel() == "tip error [mm]"
    assert bar.get_ylim() == path.get_clim()
    left, right, bottom, top = ax.axis()
    assert ((pieces > [left, bottom]) & (pieces < [right, top])).all()
    assert labels(ax) == ["commanded"]
    lightest = path.cmap(1.0)[:3] @ np.array([0.2126, 0.7152, 0.0722])
    assert lightest < 0.75  # seen on white


def test_work_precision_is_logarithmic_and_sorted():
    measured = {"a": ([1e-3, 1e-9, 1e-6], [1.0, 3.0, 2.0]), "b": ([1e-4], [0.5])}
    ax = plotting.work_precision(measured)
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("error", "time [s]")
    first, second = ax.lines
    assert first.get_xydata().tolist() == [[1e-9, 3.0], [1e-6, 2.0], [1e-3, 1.0]]
    assert second.get_xydata().tolist() == [[1e-4, 0.5]]
    assert first.get_marker() != second.get_marker()
    assert first.get_color() != second.get_color()
    assert labels(ax) == ["a", "b"]


TASK = CircleTask()


@pytest.mark.parametrize(
    "name, call",
    [
        ("linkage", lambda: plotting.motion_profile("RRR", SOLUTION)),  # type: ignore
        ("linkage", lambda: plotting.energy_profile(None, SOLUTION)),  # type: ignore
        ("linkage", lambda: plotting.effort_profile(None, (), SOLUTION)),  # type: ignore
        ("solution", lambda: plotting.motion_profile(LINKAGE, BATCH)),
        ("solution", lambda: plotting.energy_profile(LINKAGE, NOWHERE)),
        ("fig", lambda: plotting.energy_profile(LINKAGE, SOLUTION, 1)),  # type: ignore
        ("forces", lambda: plotting.effort_profile(LINKAGE, [], SOLUTION)),  # type: ignore
        ("task", lambda: plotting.tracking(LINKAGE, None, {"a": SOLUTION})),  # type: ignore
        ("solutions", lambda: plotting.tracking(LINKAGE, TASK, {})),
        ("solutions", lambda: plotting.tracking_error(LINKAGE, TASK, SOLUTION)),  # type: ignore
        (r"solutions\['a'\]", lambda: plotting.tracking(LINKAGE, TASK, {"a": BATCH})),
        ("task", lambda: plotting.tracking_by_error(LINKAGE, None, SOLUTION)),  # type: ignore
        ("solution", lambda: plotting.tracking_by_error(LINKAGE, TASK, BATCH)),
        ("solution", lambda: plotting.energy_stack(LINKAGE, (), NOWHERE)),
        ("forces", lambda: plotting.energy_stack(LINKAGE, [], SOLUTION)),  # type: ignore
        ("measured", lambda: plotting.work_precision({})),
        (r"measured\['a'\]", lambda: plotting.work_precision({"a": [1, 2]})),  # type: ignore
        (r"measured\['a'\]", lambda: plotting.work_precision({"a": ([1, 2], [1])})),
        (r"measured\['a'\]", lambda: plotting.work_precision({"a": ([0], [1])})),
    ],
)  # fmt: skip
def test_malformed_arguments_are_named(name, call):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        call()
    assert not plt.get_fignums()
