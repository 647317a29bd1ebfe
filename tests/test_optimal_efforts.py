"""The best open-loop efforts: Fuller's control of a slide; no controller is better."""

import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.analysis.measures import tip_deviation
from fdof_jax.search import Lanes
from fdof_jax.tuning import optimal_motion

# The same for all tests, so that they share programs.
HORIZON, KNOTS = 0.5, 26
# Of two joints, whose programs compile faster, beside an element whose efforts are not
# those that are sought.
OTHER = fj.forces.EffortHistory([0.0, 1.0], np.zeros((2, 2)))
CIRCLE = scenes.two_link_circle()
CONTROLLER = CIRCLE.forces[0]
SCENE = CIRCLE._replace(forces=(OTHER, CONTROLLER))


def rms_tip_error(scene, task):
    """Returns the rms tip error by the trapezium rule, from a motion of its own."""
    ts = np.linspace(0, HORIZON, 501)
    solution = fj.simulate(scene, ts)
    squares = np.sum(tip_deviation(scene.linkage, task, solution) ** 2, axis=1)
    return np.sqrt(np.trapezoid(squares, ts) / HORIZON)


@pytest.fixture(scope="module")
def best():
    return fj.tuning.optimal_efforts(SCENE, horizon=HORIZON, knots=KNOTS)


@pytest.mark.slow
def test_no_controller_with_these_limits_does_better(best):
    task, limit = CONTROLLER.reference, np.asarray(CONTROLLER.limit)
    assert best.converged
    assert (np.abs(best.efforts) <= limit).all()
    assert (np.abs(best.efforts) == limit).any()
    # Both guesses lead to the same result.
    np.testing.assert_allclose(best.guess_errors, best.tip_error, rtol=1e-3)
    assert rms_tip_error(best.scene, task) == pytest.approx(best.tip_error, rel=2e-3)
    own = rms_tip_error(CIRCLE, task)
    assert best.controller_error == pytest.approx(own, rel=2e-3)
    torque = fj.control.ComputedTorque(100.0, 20.0, limit, task, None)
    known = rms_tip_error(CIRCLE._replace(forces=(torque,)), task)
    assert best.tip_error < 0.6 * min(known, own)
    assert best.bound(2.0) == pytest.approx(best.tip_error / 2)
    with pytest.raises(ValueError, match="t1: expected"):
        best.bound(0.3)
    assert f"{1e3 * best.tip_error:.5g} mm" in str(best)


@pytest.mark.slow
def test_derivatives_against_differences(best):
    limit = np.asarray(CONTROLLER.limit)
    problem = SCENE, best.ts, np.array(1e-9), best.solution.ts
    lanes = Lanes(optimal_motion._lane, [[problem]], starts=2)
    draw = np.random.default_rng(0)
    z = 0.9 * (best.efforts / limit).ravel()
    for _ in range(3):
        change = 1e-5 * draw.normal(size=z.size)
        after, before = lanes(np.stack([z + change, z - change]), np.arange(2)).loss
        here = lanes(np.stack([z, z]), np.arange(2))
        slope = here.gradient[0] @ change
        assert (after - before) / 2 == pytest.approx(slope, rel=1e-4)


def fuller(offset, push):
    """Returns the least integral of x^2 from rest at `offset`, and its duration.

    The acceleration is limited to |x''| <= `push`. In this problem of Fuller the
    best control switches where x = -c v |v| / push, ever faster.
    """
    c = np.sqrt((np.sqrt(33) - 1) / 24)
    x, v, integral, time = offset, 0.0, 0.0, 0.0
    for _ in range(30):
        # Pushed back until the switch, at which the signs are turned.
        curve = [-(0.5 + c) * push, (1 + 2 * c) * v, x - c * v**2 / push]
        lasting = max(np.roots(curve))
        path = np.polynomial.Polynomial([x, v, -push / 2])
        integral += (path**2).integ()(lasting)
        time += lasting
        x, v = -path(lasting), -(v - push * lasting)
    return integral, time


def two_slides():
    """Returns two crossed slides without gravity, and a point as their path."""
    linkage = fj.Linkage(
        "PP", length=[0, 1, 1], com=[[0, 0], [0, 0]], mass=[1, 5], inertia=[1, 1],
        locked=[np.pi / 2, 0], gravity=0,
    )  # fmt: skip
    start = fj.inverse_kinematics(linkage, [-2.0, 3.0], None)
    point = fj.references.Ellipse([-2.3, 3.2], [0.0, 0.0])
    task = fj.TipTask(point, fj.references.Laps(period=2.0), orientation=None)
    controller = fj.PDController(100.0, 10.0, [120.0, 80.0], task)
    state0 = fj.State(start, np.zeros(2))
    return fj.Scene(linkage, state0, (OTHER, controller), 1.0)


@pytest.mark.slow
def test_slides_are_controlled_as_fuller_found():
    scene = two_slides()
    found = fj.tuning.optimal_efforts(scene, horizon=HORIZON, knots=KNOTS)
    # The first slide moves everything up, the second moves all but link 1 to the left.
    (up, t_up), (left, t_left) = fuller(0.2, 120 / 6), fuller(0.3, 80 / 5)
    assert max(t_up, t_left) < HORIZON
    least = np.sqrt((up + left) / HORIZON)
    assert least < found.tip_error < 1.01 * least


@pytest.mark.slow
def test_joints_without_a_limit_or_fixed_have_no_effort():
    """One step gives no bound, which the scene's own controller, tuned, would beat."""
    task = CONTROLLER.reference
    motorless = CONTROLLER.replace(limit=[600.0, 0.0])
    found = fj.tuning.optimal_efforts(
        SCENE._replace(forces=(OTHER, motorless)),
        horizon=HORIZON, knots=KNOTS, max_steps=1,
    )  # fmt: skip
    assert found.efforts[:, 0].any() and not found.efforts[:, 1].any()
    assert not found.converged
    with pytest.raises(RuntimeError, match="bound: expected a search that has conv"):
        found.bound(1.0)
    # About the first joint, with the second one fixed; it need not be reached.
    circle = task.replace(path=fj.references.Ellipse([0.0, 0.0], [2.0, 2.0]))
    fixed = CONTROLLER.replace(limit=[600.0, np.inf], reference=circle)
    scene = SCENE._replace(
        linkage=SCENE.linkage.replace(topology="RF", locked=[0.0, 0.0]),
        state0=fj.State(np.zeros(2), np.zeros(2)),
        forces=(OTHER, fixed),
    )
    found = fj.tuning.optimal_efforts(scene, horizon=HORIZON, knots=KNOTS, max_steps=1)
    assert found.efforts[:, 0].any() and not found.efforts[:, 1].any()
