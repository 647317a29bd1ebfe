"""Tuning within limits: a written-out optimum, margins, limits out of reach."""

import numpy as np
import pytest
from helpers import random_linkage
from scipy import signal
from test_control import PENDULUM, Stand, pd_at

import fdof_jax as fj
from fdof_jax.analysis import loop_matrices
from fdof_jax.tuning.within_limits import excess, measured, sensitivity

FREE = PENDULUM.replace(gravity=0)
INERTIA = 0.3 + 2 * (0.6**2 + 0.2**2)


def step(kp=6.0, kd=1.0, limit=np.inf):
    pd = fj.PDController([kp], [kd], [limit], Stand(np.ones(1)))
    return fj.Scene(FREE, fj.State([0.0], [0.0]), (pd,), 4.0)


def within(scene, **limits):
    return fj.tuning.tune_within(
        scene, fj.tuning.Limits(**limits), loss=fj.tuning.joint_errors, factor=8.0
    )


@pytest.mark.slow
def test_gains_are_at_the_limits_of_overshoot_and_effort():
    """The mean squared error of a step falls with kp, and is least at a damping ratio
    of 1/2, which overshoots by 16 %."""
    found = within(step(), overshoot=0.05, settling_time=4.0, effort=12.0)
    names = ("overshoot", "settling time [s]", "effort [N m]")
    assert found.met.all() and found.limit == names
    np.testing.assert_allclose(found.reached[[0, 2]], [0.05, 12], rtol=0.03)
    kp, kd = found.gains[:, 0]
    # The reference stands, so that kd damps only.
    ts, response = signal.step(([kp], [INERTIA, kd, kp]), T=np.linspace(0, 4, 40001))
    np.testing.assert_allclose(found.reached[0], response.max() - 1, rtol=1e-2)
    settled = ts[np.abs(response - 1) > 0.02].max()
    np.testing.assert_allclose(found.reached[1], settled, atol=2 * 4 / 1000)
    np.testing.assert_allclose(kp, 12, rtol=3e-3)
    ratio = np.log(1 / 0.05) / np.hypot(np.pi, np.log(1 / 0.05))
    np.testing.assert_allclose(kd / (2 * np.sqrt(kp * INERTIA)), ratio, rtol=0.01)
    # The loss of the tuned scene, without a price.
    motion = fj.simulate(found.scene, np.linspace(0, 4, 1001))
    np.testing.assert_allclose(found.loss, np.mean((motion.q - 1) ** 2), rtol=1e-6)


@pytest.mark.slow
def test_margins_are_met_and_limits_that_do_not_bind_change_nothing():
    few, many = within(step(), effort=12.0), within(step(), effort=12.0, overshoot=0.3)
    np.testing.assert_allclose(few.gains, many.gains, rtol=1e-3)
    assert many.met.all() and many.reached[0] < 0.2
    found = within(step(), effort=12.0, modulus_margin=0.95)
    assert found.met.all()
    _, least = found.reached
    assert 0.95 <= least < 0.96  # more than at the least error
    (pd,) = found.scene.forces
    loop = fj.analysis.open_loop(FREE, [1.0], pd, 1)
    assert least == pytest.approx(fj.analysis.margins(loop).modulus)


@pytest.mark.slow
def test_settling_times_are_met():
    found = within(step(), effort=12.0, settling_time=1.2)
    assert found.met.all()
    (pd,) = found.scene.forces
    motion = fj.simulate(found.scene, np.linspace(0, 4, 1001))
    test = fj.analysis.response(FREE, (pd,), motion)
    assert found.reached[0] == pytest.approx(test.settling_time[0], abs=0.01)
    # Within 2 % after 1.2 s by less overshoot than is best for the error.
    kp, kd = found.gains[:, 0]
    assert kd / (2 * np.sqrt(kp * INERTIA)) > 0.7


@pytest.mark.slow
def test_limits_of_a_joint_that_is_faster_than_the_samples_are_measured():
    frequency, ratio = 190.0, 0.3
    kp, kd = frequency**2 * INERTIA, 2 * ratio * frequency * INERTIA
    limits = fj.tuning.Limits(
        overshoot=[0.4], settling_time=[1.0], effort=[1e6], modulus_margin=[0.0]
    )
    rows = measured(step(kp, kd)._replace(t1=20.0), limits)
    overshoot, settling, effort = (reached for *_, reached in rows)
    damped = np.sqrt(1 - ratio**2)
    np.testing.assert_allclose(overshoot, np.exp(-np.pi * ratio / damped), rtol=1e-3)
    np.testing.assert_allclose(effort, kp, rtol=1e-6)
    ts = np.linspace(0, 0.2, 200_001)
    angle = damped * frequency * ts + np.arccos(ratio)
    away = np.exp(-ratio * frequency * ts) * np.sin(angle) / damped
    settled = ts[np.abs(away) > 0.02].max()
    np.testing.assert_allclose(settling, settled, rtol=1e-3)
    with pytest.raises(ValueError, match=r"scene\.t1: expected at most .* rad/s, got"):
        list(measured(step(kp, kd)._replace(t1=1e5), limits))


@pytest.mark.slow
def test_limits_out_of_reach_are_exceeded_least():
    """In 0.05 s the arm moves by a few percent, at the most that kp may grow to."""
    found = within(step(), settling_time=0.05, effort=12.0)
    assert not found.met.any()
    greatest = []
    for factor in (0.9, 1.0, 1.1):  # of kp, on which both depend
        gains = found.gains[:, 0] * [factor, 1.0]
        ts = np.linspace(0, 4, 1001)
        motion = fj.simulate(step(*gains), ts)
        late = np.abs(motion.q[ts > 0.046] - 1).max() - 0.02  # from the sample before
        greatest.append(max(late, gains[0] / 12 - 1))
    assert np.argmin(greatest) == 1
    text, html = str(found), found._repr_html_()
    assert "not met" in text and "0 of 2 limits met (none found that" in text
    assert "<th>effort [N m] of R1</th><td>12</td>" in html


@pytest.mark.slow
def test_the_margins_that_are_tuned_are_those_of_the_loops():
    rng = np.random.default_rng(2)
    linkage, q = random_linkage("RPR", rng), rng.uniform(-1, 1, 3)
    gains = fj.control.gains_from_frequency(linkage, q, [8.0, 20.0, 60.0], 0.3)
    pd = pd_at(q, *gains)
    A, B, C, _ = loop_matrices(linkage, q, pd)
    found = sensitivity(A, B, C)
    least = 1 / np.abs(found).max(axis=0)
    loops = (fj.analysis.open_loop(linkage, q, pd, k) for k in (1, 2, 3))
    exact = [fj.analysis.margins(loop).modulus for loop in loops]
    np.testing.assert_allclose(np.minimum(least, 1), exact, rtol=5e-3)


@pytest.mark.slow
def test_a_response_that_creeps_from_below_has_not_settled():
    slow = step(kp=1.0, kd=5.0)
    motion = fj.simulate(slow, np.linspace(0, 4, 1001))
    assert (motion.q < 0.9).all()
    limits = fj.tuning.Limits(
        settling_time=[1.002], overshoot=[np.inf], effort=[np.inf]
    )
    over, unsettled, _ = excess(limits, slow, motion, False).reshape(13, 3).T
    # Farthest from 1 at the first of each 77 times, and at the last one before 1.002 s.
    assert over.max() <= 0 and unsettled[-1] == pytest.approx(0.98 - motion.q[-77, 0])
    assert motion.ts[250] == 1 and (unsettled[:3] == -1).all()
    assert unsettled[3] == pytest.approx(0.98 - float(motion.q[250, 0]), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("topology, kd", [("RF", [1.0, 1.0]), ("RR", [1.0, 0.0])])
def test_the_errors_of_a_joint_that_nothing_drives_count_nothing(topology, kd):
    """It is fixed, or both of its gains are 0."""
    arm = fj.Linkage(
        topology, length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1] * 2, inertia=[0.1] * 2
    )
    kp, target = 5 * np.array(kd), Stand(np.array([0.2, 0.7]))
    pd = fj.PDController(kp, kd, np.inf, target)
    scene = fj.Scene(arm, fj.State(np.zeros(2), np.zeros(2)), (pd,), 1.0)
    motion = fj.simulate(scene, [0.0, 1.0])
    errors = fj.tuning.joint_errors(scene, motion).reshape(2, 2)
    assert (errors[:, 1] == 0).all() and (errors[:, 0] != 0).all()
    damped = scene._replace(forces=(pd.replace(kd=[1.0, 0.1]),))
    errors = fj.tuning.joint_errors(damped, motion)
    assert (errors != 0).all() == (topology == "RR")
