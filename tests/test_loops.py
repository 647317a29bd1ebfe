"""Loops: peaks, hidden states of drives, and how joints follow their references."""

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from test_gains import PENDULUM, Stand, arm, pd_at, state_space

import fdof_jax as fj
from fdof_jax.analysis.transfer import Transfer

# A pendulum's inertia about its pivot, and the slope of its weight, at 0.8 rad.
INERTIA = 0.3 + 2 * (0.6**2 + 0.2**2)
FALL = -2 * 9.81 * (0.6 * np.sin(0.8) + 0.2 * np.cos(0.8))
POSITION = np.array([0.8])


def least_distance(loop):
    """Returns the least |1 + L| by fine samples around each mode of the closed loop."""
    system, found = state_space(loop), [1.0]
    distance = lambda w: np.abs(1 + system(1j * w))
    for mode in np.linalg.eigvals(system.A - system.B @ system.C):
        near = np.abs(mode.imag) - 20 * mode.real * np.linspace(-1, 1, 2001)
        near = near[near > 0]
        k = np.clip(distance(near).argmin(), 1, len(near) - 2)
        ends = near[k - 1], near[k + 1]
        exact = dict(xatol=1e-9)
        found.append(minimize_scalar(distance, bounds=ends, options=exact).fun)
    return min(found)


@pytest.mark.parametrize("seed, ratio", [(3, 5e-4), (9, 5e-5)])
def test_the_modulus_margin_of_a_lightly_damped_loop(seed, ratio):
    """Peaks are narrower than samples of the frequency are apart."""
    linkage, q = arm("RRR", seed)
    linkage = linkage.replace(gravity=0)
    gains = fj.control.gains_from_frequency(linkage, q, [8, 8.8, 60], ratio)
    for joint in (1, 2, 3):
        loop = fj.analysis.open_loop(linkage, q, pd_at(q, *gains), joint)
        expected = least_distance(loop)
        np.testing.assert_allclose(loop.modulus_margin, expected, rtol=1e-5)


def test_peaks_and_crossings_of_written_out_functions():
    w, z = 50.0, 1e-4  # w^2 / (s^2 + 2 z w s + w^2)
    low = Transfer(np.array([[0, 1], [-(w**2), -2 * z * w]]), np.array([0, w**2]),
                   np.array([1.0, 0]))  # fmt: skip
    np.testing.assert_allclose(low.peak(), 1 / (2 * z * np.sqrt(1 - z**2)), rtol=1e-8)
    # With x = (frequency / w)^2, (1 - x)^2 + 4 z^2 x = 1 / level^2.
    (x,) = [x for x in np.roots([1, 4 * z**2 - 2, 1 - 4]) if x > 0]
    np.testing.assert_allclose(low.crossings(0.5), w * np.sqrt(x))
    below, above = low.crossings(100.0)
    np.testing.assert_allclose(below**2 + above**2, 2 * w**2 * (1 - 2 * z**2))
    assert not low.crossings(1e4).size and not low.crossings(0.0).size
    # What is left of 1 has its peak beside the zero's mode, and goes to 1.
    rest = low._replace(C=-low.C, D=1.0)
    s = 1j * np.array([1.0, 50.0, 1e3])
    np.testing.assert_allclose(rest(s.imag), 1 - low(s.imag), rtol=1e-9)
    assert rest.peak() == pytest.approx(np.abs(1 - low(w)), rel=1e-3)
    high = Transfer(np.array([[-2.0]]), np.array([2.0]), np.array([-1.0]), 1.0)
    assert high.peak() == pytest.approx(1)  # s / (s + 2), at no finite frequency
    np.testing.assert_allclose(high.crossings(0.6), 1.5)


@pytest.mark.parametrize("kp, ki, kd, lag, fall", [
    (185270.0, 3800916.0, 455.15, 4.8744e-4, 0.55),
    (1e6, 3e7, 1e3, 2e-4, 0.0),
])  # fmt: skip
def test_the_gain_margin_of_stiff_loops(kp, ki, kd, lag, fall):
    """With J s^2 - fall = u, Routh's border is at kp = fall + J ki / (kd - lag kp)."""
    A = np.array([
        [0, 1, 0, 0], [fall / 4.4, 0, 0, 0],
        [-kp / lag, -kd / lag, -1 / lag, 1 / lag], [-ki, 0, 0, 0],
    ])  # fmt: skip
    none = np.zeros(4)
    B, C = np.array([0, 1 / 4.4, 0, 0]), np.array([0, 0, -1.0, 0])
    loop = fj.analysis.OpenLoop(A, B, C, none, none, 0.0, "R1")
    expected = (fall + 4.4 * ki / (kd - lag * kp)) / kp
    assert loop.gain_margin == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("gains", [(80.0, 40.0), ([80.0, 0.0], [40.0, 0.0])])
@pytest.mark.parametrize("speed", [False, True])
def test_an_integral_of_a_fixed_pair_within_a_drive_is_no_state(gains, speed):
    """It integrates without end, but acts on nothing that moves."""
    q = np.array([0.8, 0.0])
    longer = fj.Linkage(
        "RF", length=[0, 1, 1], com=[[0.6, 0.2], [0.5, 0]], mass=[2, 1],
        inertia=[0.3, 0.1],
    )  # fmt: skip
    kp, ki = gains
    controller = fj.control.PIDController(kp, ki, 9.0, np.inf, Stand(q))
    if speed:
        controller = fj.control.SpeedLimit(controller, stall=1e3, no_load=1e3)
    lagged = fj.control.FirstOrderLag(controller, 0.002)
    loop = fj.analysis.open_loop(longer, q, lagged, joint=1)
    assert loop.A.shape == (4, 4) and loop.stable
    inertia = float(fj.mass_matrix(longer, q)[0, 0])
    fall = float(fj.analysis.holding_efforts(longer, q + [1e-6, 0])[0])
    fall = (fall - float(fj.analysis.holding_efforts(longer, q - [1e-6, 0])[0])) / 2e-6
    s = 1j * np.geomspace(0.1, 1000, 9)
    expected = (80 + 40 / s + 9 * s) / (0.002 * s + 1) / (inertia * s**2 + fall)
    np.testing.assert_allclose(loop(s.imag), expected, rtol=1e-6)


# How joints follow their references


def bandwidth_of(response):
    """Returns where |T| first falls 3 dB below |T(0)|, by samples and bisection."""
    level = lambda w: np.abs(response(1j * w) / response(0)) - 10 ** (-3 / 20)
    w = np.geomspace(1e-2, 1e4, 20001)
    first = int(np.argmax(level(w) < 0))
    return brentq(level, w[first - 1], w[first])


def follower(kind, **others):
    return kind(
        kp=[90.0], kd=[6.0], limit=[np.inf], reference=Stand(POSITION), **others
    )


MOTOR = dict(resistance=1.0, inductance=1e-3, constant=3.0)
FOLLOWERS = {
    "PD": (
        follower(fj.PDController),
        lambda s: (90 + 6 * s) / (INERTIA * s**2 + 6 * s + 90 + FALL),
    ),
    "gravity feedforward": (
        follower(fj.control.GravityFeedforward),
        lambda s: (90 + 6 * s) / (INERTIA * s**2 + 6 * s + 90),
    ),
    "PID": (
        fj.control.PIDController([90.0], [50.0], [6.0], [np.inf], Stand(POSITION)),
        lambda s: (50 + 90 * s + 6 * s**2)
        / (INERTIA * s**3 + 6 * s**2 + (90 + FALL) * s + 50),
    ),
    "motor": (
        fj.control.DCMotor(follower(fj.PDController), **MOTOR),
        # The back-EMF acts on speeds, but not on those of the reference.
        lambda s: 3 * (90 + 6 * s)
        / ((INERTIA * s**2 + FALL) * (1e-3 * s + 1) + 9 * s + 3 * (90 + 6 * s)),
    ),
    "plain reference": (
        fj.PDController([90.0], [6.0], [np.inf], lambda t, k: (POSITION, 0 * POSITION)),
        lambda s: (90 + 6 * s) / (INERTIA * s**2 + 6 * s + 90 + FALL),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FOLLOWERS)
def test_the_bandwidth_is_that_of_the_response_to_the_reference(name):
    controller, response = FOLLOWERS[name]
    loop = fj.analysis.open_loop(PENDULUM, POSITION, controller, joint=1)
    following = Transfer(loop.A - np.outer(loop.B, loop.C), loop.F, loop.G, loop.D)
    w = np.geomspace(0.1, 1e3, 9)
    np.testing.assert_allclose(following(w), response(1j * w), rtol=1e-8)
    np.testing.assert_allclose(loop.bandwidth, bandwidth_of(response), rtol=1e-9)


def test_computed_torque_follows_at_all_frequencies():
    """With an error of the model it does not: its inertia is that of its own model."""
    loop = fj.analysis.open_loop(
        PENDULUM, POSITION, follower(fj.control.ComputedTorque), joint=1
    )
    assert loop.bandwidth == np.inf and "bandwidth       inf rad/s" in str(loop)
    light = PENDULUM.replace(mass=[0.5], inertia=[0.1])
    control = follower(fj.control.ComputedTorque, model=light)
    loop = fj.analysis.open_loop(PENDULUM, POSITION, control, joint=1)
    believed, fall = 0.1 + 0.5 * (0.6**2 + 0.2**2), 0.25 * FALL

    def response(s):
        gained = believed * (s**2 + 6 * s + 90)
        return gained / (INERTIA * s**2 + believed * (6 * s + 90) + FALL - fall)

    np.testing.assert_allclose(loop.bandwidth, bandwidth_of(response), rtol=1e-9)


def test_joints_follow_while_others_hold():
    """Of three joints under computed torque each moves as if it were alone."""
    linkage, q = arm("RPR")
    torque = fj.control.ComputedTorque(90.0, 6.0, np.inf, Stand(q))
    for joint in (1, 2, 3):
        loop = fj.analysis.open_loop(linkage, q, torque, joint)
        following = Transfer(loop.A - np.outer(loop.B, loop.C), loop.F, loop.G, loop.D)
        np.testing.assert_allclose(following([0.0, 1.0, 30.0, 1e3]), 1, rtol=1e-8)


def test_a_controller_without_a_reference_has_no_bandwidth():
    plain = lambda t, q, qd, linkage: -90 * (q - 0.8) - 6 * qd
    loop = fj.analysis.open_loop(PENDULUM, POSITION, plain, joint=1)
    assert loop.stable and np.isnan(loop.bandwidth) and "bandwidth" not in str(loop)
