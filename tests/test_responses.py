"""Steps and sines: python-control for small ones, limits for large ones, refusals."""

import control
import numpy as np
import pytest
from helpers import random_linkage
from test_control import pd_at

import fdof_jax as fj
from fdof_jax.analysis.measures import step_measures

STEP, DURATION = 1e-4, 3.0


@pytest.fixture(scope="module")
def arm():
    rng = np.random.default_rng(3)
    return random_linkage("RPR", rng), rng.uniform(-1, 1, 3)


def controller_of(linkage, q, limit=np.inf):
    gains = fj.control.gains_from_frequency(linkage, q, [8.0, 15.0, 20.0], 0.5)
    pd = pd_at(q + 7, *gains)  # whose own reference is not used
    return fj.PDController(pd.kp, pd.kd, np.full(3, limit), pd.reference)


@pytest.fixture(scope="module")
def small(arm):
    linkage, q = arm
    pd = controller_of(linkage, q)
    return fj.analysis.step_and_sine(linkage, q, pd, step=STEP, duration=DURATION)


@pytest.mark.slow
def test_small_steps_and_sines_agree_with_python_control(arm, small):
    linkage, q = arm
    pd = controller_of(linkage, q)
    # Where the arm rests, sagging.
    hold = pd_at(q, pd.kp, pd.kd)
    rest = fj.analysis.equilibrium(linkage, q, (hold,))
    ts = np.linspace(0, DURATION, 20001)
    for k in range(3):
        loop = fj.analysis.open_loop(linkage, rest, hold, k + 1)
        # The set point acts through kp alone, and through kd with its velocity.
        closed, position = loop.feedback(), np.eye(6)[[k]]
        by_kp = control.ss(closed.A, pd.kp[k] * loop.B, position, 0)
        _, y = control.step_response(by_kp, ts)
        info = control.step_info(y, ts)
        spacing = 2 * DURATION / 20000
        times = info["RiseTime"], info["SettlingTime"]
        found = small.rise_time[k], small.settling_time[k]
        np.testing.assert_allclose(found, times, atol=2 * spacing)
        overshoot = info["Overshoot"] / 100
        np.testing.assert_allclose(small.overshoot[k], overshoot, atol=1e-4)
        sampled = np.interp(small.ts, ts, y)
        np.testing.assert_allclose(small.response[k], sampled, atol=1e-3)
        gain = closed(1j * small.frequency[k])
        np.testing.assert_allclose(small.gain[k], gain, atol=1e-3)
        bandwidth = control.bandwidth(closed)
        np.testing.assert_allclose(small.bandwidth[k], bandwidth, rtol=2e-4)
        assert small.saturated[k] == 0


@pytest.mark.slow
def test_a_joint_that_is_faster_than_a_thousand_samples():
    """A slow joint needs the time; the response of a fast one is over in 30 ms."""
    duration = 12.0
    linkage = fj.Linkage(
        "RR", length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1] * 2, inertia=[1 / 12] * 2,
        gravity=0,
    )  # fmt: skip
    q = np.array([0.3, 0.8])
    gains = fj.control.gains_from_frequency(linkage, q, [1, 150], [0.7, 0.3])
    pd = pd_at(q, *gains)
    found = fj.analysis.step_and_sine(linkage, q, pd, step=1e-4, duration=duration)
    closed = fj.analysis.open_loop(linkage, q, pd, joint=2).feedback()
    modes, vectors = np.linalg.eig(closed.A)
    # y = C A^-1 (e^(A t) - 1) B
    kicks = np.linalg.solve(vectors, pd.kp[1] * closed.B[:, 0] + 0j)
    parts = vectors[1] * kicks / modes
    response = lambda t: np.real(np.expm1(np.multiply.outer(t, modes)) @ parts)
    ts = np.linspace(0, 0.2, 400_001)
    share = response(ts) / response(duration)
    overshoot, settling = share.max() - 1, ts[np.abs(share - 1) > 0.02].max()
    rise = ts[np.argmax(share >= 0.9)] - ts[np.argmax(share >= 0.1)]
    measures = found.overshoot[1], found.rise_time[1], found.settling_time[1]
    np.testing.assert_allclose(measures, (overshoot, rise, settling), rtol=1e-3)
    bandwidth = fj.analysis.bandwidth(fj.analysis.closed_loop(linkage, q, pd, 2))
    np.testing.assert_allclose(found.bandwidth[1], bandwidth, rtol=2e-4)
    assert len(found.ts) > 4 * duration * 150 and (np.diff(found.ts) > 0).all()
    with pytest.raises(ValueError, match="duration: expected at most .* rad/s, got"):
        fj.analysis.step_and_sine(linkage, q, pd, step=1e-4, duration=1e5)


@pytest.mark.slow
def test_an_arm_that_follows_all_sines_has_no_bandwidth():
    rod = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
    stand = pd_at(np.zeros(1), 1, 1).reference
    torque = fj.control.ComputedTorque([90.0], [6.0], [np.inf], stand)
    test = fj.analysis.step_and_sine(rod, [0.0], torque, step=0.1, duration=3.0)
    np.testing.assert_allclose(test.gain, 1, rtol=1e-3)
    assert np.isnan(test.bandwidth).all() and (test.overshoot > 0.1).all()


@pytest.mark.slow
def test_weak_actuators_are_slower_and_at_their_limits(arm, small):
    linkage, q = arm
    light = linkage.replace(gravity=0)
    pd = controller_of(light, q, limit=30.0)
    large = fj.analysis.step_and_sine(light, q, pd, step=0.8, duration=DURATION)
    assert (large.saturated > 0.02).all()
    assert (large.bandwidth < 0.8 * small.bandwidth).all()


@pytest.mark.slow
def test_an_arm_that_does_not_come_to_rest_is_not_settled(arm):
    linkage, q = arm
    undamped = pd_at(q, controller_of(linkage, q).kp, 0)
    test = fj.analysis.step_and_sine(linkage, q, undamped, step=STEP, duration=DURATION)
    assert np.isnan(test.settling_time).all()


def test_a_response_that_creeps_or_fails_has_no_rise_time():
    ts = np.linspace(0, 2, 1001)
    change, rate = 1 - np.exp(-ts), np.exp(-ts)  # 0.86 at the end
    assert str(step_measures(ts, change, rate, 1.0)) == str((0.0, np.nan, np.nan))
    rise = step_measures(ts, change, rate, change[-1])[1]
    part = lambda share: -np.log1p(-share * change[-1])
    np.testing.assert_allclose(rise, part(0.9) - part(0.1), rtol=1e-3)
    assert np.isnan(step_measures(ts, np.full(1001, np.nan), rate, np.nan)).all()


@pytest.mark.slow
def test_a_report_is_shown(small):
    assert str(small).count("\n") == 4 and "overshoot" in str(small)
    assert f"{STEP:.4g}" in str(small) and "<th>P2</th>" in small._repr_html_()
    fig = fj.plotting.response_profile(small)
    above, below = fig.axes
    assert [line.get_label() for line in above.lines] == ["reference", "R1", "P2", "R3"]
    assert below.get_xscale() == "log"


@pytest.mark.slow
def test_malformed_tests_are_refused(arm):
    linkage, q = arm
    pd = controller_of(linkage, q)
    pid = fj.control.PIDController(9.0, 1.0, 1.0, np.inf, pd.reference)
    loose = fj.PDController([9.0, 0.0, 9.0], pd.kd, pd.limit, pd.reference)
    weightless = linkage.replace(gravity=0)
    heavy, weak = linkage.replace(gravity=9.81), controller_of(linkage, q, limit=0.1)
    for arguments, step, message in [
        ((linkage, q, pd), 0, "step: .* above 0"),
        ((linkage, q, pid), 1, "controller: expected a PDController, or a drive"),
        ((weightless, q, loose), 1, "controller: expected one with which each joint"),
        ((heavy, q, weak), 1, r"controller: .* limits .* got \[0.1, .* needs"),
    ]:
        with pytest.raises(ValueError, match=message):
            fj.analysis.step_and_sine(*arguments, step=step, duration=1.0)
    with pytest.raises(ValueError, match="test: expected a StepAndSine"):
        fj.plotting.response_profile(pd)


@pytest.mark.slow
@pytest.mark.parametrize("step", [1e-6, 1e-3])
def test_responses_start_where_the_arm_rests(step):
    """A soft link sags by 0.4 rad; what it does about there is known in closed form."""
    rod = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
    kp, kd, weight, inertia = 10.0, 1.5, 0.5 * 9.81, 0.35
    pd = pd_at(np.zeros(1), np.array([kp]), np.array([kd]))
    found = fj.analysis.step_and_sine(rod, [0.0], pd, step=step, duration=3.0)
    (sag,) = fj.analysis.equilibrium(rod, [0.0], (pd,))
    assert sag < -0.4
    stiffness = kp - weight * np.sin(sag)
    damping = kd / (2 * np.sqrt(stiffness * inertia))
    overshoot = np.exp(-np.pi * damping / np.sqrt(1 - damping**2))
    np.testing.assert_allclose(found.overshoot, overshoot, rtol=0.02)
