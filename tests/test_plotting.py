"""Curves show the right numbers, labels and units, not pixels."""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from test_drawing import (
    BATCH,
    LINKAGE,
    NOWHERE,
    SOLUTION,
    labels,
    made_up,
    make_linkage,
    named,
    swinging,
    tidy as tidy,
)

from fdof_jax import CircleTask, JointDamper, PDController, plotting, tip_position


def values(ax: Axes) -> list[np.ndarray]:
    return [np.asarray(line.get_ydata()) for line in ax.lines]


def test_motion_profile_shows_absolute_angles_in_degrees_and_slides():
    solution = swinging()
    fig = plotting.motion_profile(make_linkage("RPR"), solution)
    angles, slides = fig.axes
    assert angles.get_ylabel() == "angle [degrees]"
    assert slides.get_ylabel() == "slide [m]"
    assert slides.get_xlabel() == "time [s]"
    assert labels(angles) == [r"$\theta_2$", r"$\theta_4$"]
    assert labels(slides) == ["$B_2$"]
    q = np.asarray(solution.q)
    th2, th4 = values(angles)
    np.testing.assert_allclose(th2, np.rad2deg(0.4 + q[:, 0]))
    np.testing.assert_allclose(th4, np.rad2deg(0.4 + q[:, 0] + 0.7 + q[:, 2]))
    np.testing.assert_allclose(values(slides)[0], q[:, 1])
    only = plotting.motion_profile(make_linkage("RRR"), solution, plt.figure())
    assert len(only.axes) == 1


def test_energy_profile_adds_up():
    fig = plotting.energy_profile(make_linkage("PRR"), swinging())
    kinetic, potential, whole = fig.axes
    assert all("[J]" in ax.get_ylabel() for ax in fig.axes)
    assert labels(kinetic) == ["link 2", "link 3", "link 4"]
    assert labels(whole) == ["kinetic", "potential", "total"]
    sums = [sum(values(ax)) for ax in (kinetic, potential)]
    for total, expected in zip(values(whole), (*sums, sums[0] + sums[1])):
        np.testing.assert_allclose(total, expected, atol=1e-12)


def hold(t, linkage):
    return jnp.zeros(3), jnp.zeros(3)


def test_effort_profile_has_units_limits_and_saturation():
    q = np.zeros((11, 3))
    q[:5, 1] = 0.1  # beyond the 0.03 m that saturate
    forces = (PDController(1e4, 0, [1e3, 3e2, np.inf], hold), JointDamper(1.0))
    solution = made_up(np.linspace(0, 1, 11), q)
    fig = plotting.effort_profile(make_linkage("RPR"), forces, solution)
    names = [ax.get_ylabel() for ax in fig.axes]
    assert names == ["$T_2$ [N m]", "$F_2$ [N]", "$T_4$ [N m]"]
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


def test_effort_profile_without_elements_is_zero():
    fig = plotting.effort_profile(make_linkage("PRR"), (), swinging())
    assert not any(np.any(values(ax)) for ax in fig.axes)


def test_tracking_and_its_error():
    linkage, task = make_linkage("RRR"), CircleTask([1, 1], 0.5, 2.0, 0.0)
    solutions = {"paper": swinging(), "tuned": swinging(51, 0.5)}
    ax = plotting.tracking(linkage, task, solutions)
    assert labels(ax) == ["paper", "tuned", "commanded"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    curves = {line.get_label(): np.asarray(line.get_xydata()) for line in ax.lines}
    off = np.linalg.norm(curves["commanded"] - [1, 1], axis=1)
    np.testing.assert_allclose(off, 0.5)
    expected = tip_position(linkage, solutions["paper"].q[-1])
    np.testing.assert_allclose(curves["paper"][-1], expected, atol=1e-12)

    fast = plotting.tracking(linkage, CircleTask([1, 1], 0.5, 0.5), solutions)
    assert len(values(fast)[-2]) == 51  # one turn, the dashes stay dashes

    error = plotting.tracking_error(linkage, task, solutions)
    assert (error.get_xlabel(), error.get_ylabel()) == ("time [s]", "tip error [m]")
    np.testing.assert_allclose(
        values(error)[0],
        np.linalg.norm(curves["paper"] - curves["commanded"], axis=1),
    )
    assert len({line.get_color() for line in error.lines}) == 2


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
    ],
)  # fmt: skip
def test_malformed_arguments_are_named(name, call):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        call()
    assert not plt.get_fignums()
