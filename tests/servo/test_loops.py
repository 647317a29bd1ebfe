"""Loops of controllers: closed forms, margins, and how joints follow references."""

import control
import numpy as np
import pytest
from chains import random_chain
from scipy.optimize import brentq, minimize_scalar
from test_control import PENDULUM, Stand, arm, pd_at, poles

import fdof_jax as fj
from fdof_jax.analysis import bandwidth, closed_loop, margins, open_loop

# A pendulum's inertia about its pivot, and the slope of its weight, at 0.8 rad.
INERTIA = 0.3 + 2 * (0.6**2 + 0.2**2)
FALL = -2 * 9.81 * (0.6 * np.sin(0.8) + 0.2 * np.cos(0.8))
POSITION = np.array([0.8])


def test_the_loop_of_a_pendulum_is_as_written_out():
    kp, kd = 50.0, 6.0
    loop = open_loop(PENDULUM, POSITION, pd_at(POSITION, kp, kd), joint=1)
    s = 1j * np.geomspace(0.1, 100, 7)
    expected = (kp + kd * s) / (INERTIA * s**2 + FALL)
    np.testing.assert_allclose(loop(s), expected, rtol=1e-10)
    assert loop.name == "loop of R1"
    found = margins(loop)
    # It falls over if the gains are too low.
    np.testing.assert_allclose(found.gain, -FALL / kp, rtol=1e-9)
    # |kp + kd s|^2 = (inertia w^2 - fall)^2
    squares = np.roots([INERTIA**2, -2 * INERTIA * FALL - kd**2, FALL**2 - kp**2])
    crossover = np.sqrt(squares.max())
    np.testing.assert_allclose(found.crossover, crossover, rtol=1e-9)
    phase = np.arctan(kd * crossover / kp)
    np.testing.assert_allclose(found.phase, phase, rtol=1e-9)
    np.testing.assert_allclose(found.delay, phase / crossover, rtol=1e-9)


def test_loops_without_margins_have_none():
    kp, kd = 50.0, 6.0
    # Without gravity, where L is infinite at rest, no factor makes it unstable.
    weightless = PENDULUM.replace(gravity=0)
    loop = open_loop(weightless, POSITION, pd_at(POSITION, kp, kd), joint=1)
    assert margins(loop).gain == np.inf
    # Loops are not stable that fall, as gains are too low, or swing without end.
    for gains in ((1.0, 1.0), (50.0, 0.0)):
        loop = open_loop(PENDULUM, POSITION, pd_at(POSITION, *gains), joint=1)
        assert np.isnan(margins(loop)).all()
    # A controller at its limit has no loop, and the arm falls.
    pd = pd_at(POSITION + 1, kp, kd)
    limited = fj.PDController(pd.kp, pd.kd, [10.0], pd.reference)
    calls = PENDULUM, POSITION, limited, 1
    loop = open_loop(*calls)
    assert (loop([1j, 2j]) == 0).all() and np.isnan(margins(loop)).all()
    assert np.isnan(bandwidth(closed_loop(*calls)))
    # No change of the loop makes an arm unstable that hangs.
    damped = fj.JointDamper(0.1)
    hangs = margins(open_loop(PENDULUM, POSITION - np.pi, limited, 1, (damped,)))
    assert hangs.phase == hangs.gain == hangs.delay == np.inf and hangs.modulus == 1


def lagged(chain, seed, spread, ratio, lag, base=8.0):
    """Returns a random arm without weight, a configuration and a controller."""
    linkage = random_chain(chain, np.random.default_rng(seed)).replace(gravity=0)
    q = np.random.default_rng(seed).uniform(-1, 1, len(chain))
    frequency = base * np.geomspace(1, spread, len(chain))
    pd = pd_at(q, *fj.control.gains_from_frequency(linkage, q, frequency, ratio))
    return linkage, q, fj.control.FirstOrderLag(pd, lag)


@pytest.mark.slow
@pytest.mark.parametrize("chain, spread, ratio, lag", [
    ("RPR", 7.5, 0.7, 4e-3), ("RRR", 7.5, 0.7, 4e-3), ("RPR", 100.0, 0.7, 1e-4),
])  # fmt: skip
def test_loops_are_unstable_beyond_their_margins(chain, spread, ratio, lag):
    linkage, q, controller = lagged(chain, 0, spread, ratio, lag)
    for joint in (1, len(chain)):
        loop = open_loop(linkage, q, controller, joint)
        found = margins(loop)
        decay = lambda k, loop=loop: loop.A - k * loop.B @ loop.C
        decay = lambda k, f=decay: np.linalg.eigvals(f(k)).real.max()
        assert decay(1.0) < 0
        if np.isfinite(found.gain):
            nearer, beyond = found.gain ** np.array([0.999, 1.001])
            assert decay(nearer) < 0 < decay(beyond)
        else:
            assert decay(1e-3) < 0 and decay(1e3) < 0
        response = loop(1j * found.crossover)
        for turn in (found.phase, found.delay * found.crossover):
            assert response * np.exp(-1j * turn) == pytest.approx(-1, abs=1e-6)
        np.testing.assert_allclose(found.modulus, least_distance(loop), rtol=1e-5)


def least_distance(loop):
    """Returns the least |1 + L| by fine samples around each mode of the closed loop."""
    least = [1.0]
    distance = lambda w: np.abs(1 + loop(1j * w))
    for mode in loop.feedback().poles():
        near = np.abs(mode.imag) - 20 * mode.real * np.linspace(-1, 1, 501)
        near = near[near > 0]
        k = np.clip(distance(near).argmin(), 1, len(near) - 2)
        ends = near[k - 1], near[k + 1]
        least.append(
            minimize_scalar(distance, bounds=ends, options=dict(xatol=1e-9)).fun
        )
    return min(least)


@pytest.mark.slow
@pytest.mark.parametrize("seed, ratio", [(3, 5e-4), (9, 5e-5)])
def test_the_modulus_margin_of_a_lightly_damped_loop(seed, ratio):
    """Peaks are narrower than samples of the frequency are apart."""
    linkage, q = arm("RRR", seed)
    linkage = linkage.replace(gravity=0)
    gains = fj.control.gains_from_frequency(linkage, q, [8, 8.8, 60], ratio)
    for joint in (1, 2, 3):
        loop = open_loop(linkage, q, pd_at(q, *gains), joint)
        expected = least_distance(loop)
        np.testing.assert_allclose(margins(loop).modulus, expected, rtol=1e-5)


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
    loop = control.ss(A, [[0], [1 / 4.4], [0], [0]], [[0, 0, -1, 0]], 0)
    expected = (fall + 4.4 * ki / (kd - lag * kp)) / kp
    assert margins(loop).gain == pytest.approx(expected, rel=1e-8)


def test_the_phase_margin_of_a_stiff_loop_of_high_order():
    """Its polynomials overflow in seconds: L = 9 (1 + s) / s^2 behind 22 fast lags."""
    rates = np.geomspace(1e5, 1e6, 22)
    loop = control.ss([[0, 1], [0, 0]], [[0], [1]], [[9, 9]], 0)
    for rate in rates:
        loop = loop * control.ss(-rate, rate, 1, 0)
    with pytest.raises(np.linalg.LinAlgError), np.errstate(all="ignore"):
        control.stability_margins(loop)
    crossover = brentq(lambda w: 9 * np.hypot(1, w) / w**2 - 1, 1, 100)
    phase = np.arctan(crossover) - np.arctan(crossover / rates).sum()
    found = margins(loop)
    np.testing.assert_allclose(found.crossover, crossover, rtol=1e-6)
    np.testing.assert_allclose(found.phase, phase, rtol=1e-6)


def test_the_delay_margin_of_a_loop_that_leads():
    """L = 2 s / (s + 1) leads by 60 degrees where |L| = 1."""
    found = margins(control.ss(-1, 1, -2, 2))
    lags = found.phase, found.delay * found.crossover
    np.testing.assert_allclose(lags, (-2 * np.pi / 3, 4 * np.pi / 3), rtol=1e-9)


@pytest.mark.slow
def test_the_closed_loop_is_the_linearised_arm():
    linkage, q = arm("RPR")
    gains = fj.control.gains_from_frequency(linkage, q, 20.0, 0.7)
    load = fj.analysis.holding_efforts(linkage, q)
    pd = pd_at(q + load / gains[0], *gains)  # sags to q
    loop, response = (of(linkage, q, pd, joint=2) for of in (open_loop, closed_loop))
    for closed in (loop.feedback(), response):
        found = np.poly(closed.poles())
        np.testing.assert_allclose(found, np.poly(poles(linkage, q, pd)), rtol=1e-9)
    # Constant efforts hold what a controller without its load would not.
    other = open_loop(linkage, q, pd_at(q, *gains), joint=2)
    np.testing.assert_allclose(other.A, loop.A, rtol=1e-12)


def linkage_of_two(topology):
    return fj.Linkage(
        topology, length=[0, 1, 1], com=[[0.6, 0.2], [0.5, 0]], mass=[2, 1],
        inertia=[0.3, 0.1],
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kp, ki, speed", [
    (80.0, 40.0, False), ([80.0, 0.0], [40.0, 0.0], True),
])  # fmt: skip
def test_an_integral_of_a_fixed_pair_within_a_drive_is_no_state(kp, ki, speed):
    """It integrates without end, but acts on nothing that moves."""
    q, longer = np.array([0.8, 0.0]), linkage_of_two("RF")
    controller = fj.control.PIDController(kp, ki, 9.0, np.inf, Stand(q))
    if speed:
        controller = fj.control.SpeedLimit(controller, stall=1e3, no_load=1e3)
    slow = fj.control.FirstOrderLag(controller, 0.002)
    loop = open_loop(longer, q, slow, joint=1)
    assert loop.A.shape == (4, 4) and loop.feedback().poles().real.max() < 0
    inertia = float(fj.mass_matrix(longer, q)[0, 0])
    A, B = fj.linearize(longer, fj.State(q, 0 * q))
    fall = -A[2, 0] / B[2, 0]
    s = 1j * np.geomspace(0.1, 1000, 9)
    expected = (80 + 40 / s + 9 * s) / (0.002 * s + 1) / (inertia * s**2 + fall)
    np.testing.assert_allclose(loop(s), expected, rtol=1e-6)


def test_an_integral_without_a_gain_is_no_state():
    q = np.array([0.8, 0.0])
    pid = fj.control.PIDController(80.0, [40.0, 0.0], 9.0, np.inf, Stand(q))
    loop = open_loop(linkage_of_two("RR"), q, pid, joint=1)
    assert loop.A.shape == (5, 5) and np.isfinite(margins(loop).phase)


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


def pd_response(s):
    return (90 + 6 * s) / (INERTIA * s**2 + 6 * s + 90 + FALL)


PD = follower(fj.PDController)
MOTOR = dict(resistance=1.0, inductance=1e-3, constant=3.0)
FOLLOWERS = {
    "PD": (PD, pd_response),
    "plain reference": (
        fj.PDController([90.0], [6.0], [np.inf], lambda t, k: (POSITION, 0 * POSITION)),
        pd_response,
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
        fj.control.DCMotor(PD, **MOTOR),
        # The back-EMF acts on speeds, but not on those of the reference.
        lambda s: 3 * (90 + 6 * s)
        / ((INERTIA * s**2 + FALL) * (1e-3 * s + 1) + 9 * s + 3 * (90 + 6 * s)),
    ),
    "motor without inductance": (
        fj.control.DCMotor(PD, **MOTOR | dict(inductance=0)),
        lambda s: 3 * (90 + 6 * s)
        / (INERTIA * s**2 + FALL + 9 * s + 3 * (90 + 6 * s)),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLLOWERS)
def test_the_bandwidth_is_that_of_the_response_to_the_reference(name):
    controller, response = FOLLOWERS[name]
    following = closed_loop(PENDULUM, POSITION, controller, joint=1)
    s = 1j * np.geomspace(0.1, 1e3, 9)
    np.testing.assert_allclose(following(s), response(s), rtol=1e-8)
    np.testing.assert_allclose(bandwidth(following), bandwidth_of(response), rtol=1e-9)


def test_the_bandwidth_ends_at_a_narrow_dip():
    """The dip of another joint's mode, between samples of the frequency."""
    linkage, q = arm("RRR", 3)
    linkage = linkage.replace(gravity=0)
    gains = fj.control.gains_from_frequency(linkage, q, [8, 8.8, 60], 5e-4)
    response = closed_loop(linkage, q, pd_at(q, *gains), joint=3)
    edge = bandwidth(response)
    below, above = np.abs(response(1j * edge * np.array([1 - 1e-6, 1 + 1e-6])))
    assert above < 10 ** (-3 / 20) < below
    assert control.bandwidth(response) > 3 * edge


@pytest.mark.slow
def test_computed_torque_follows_at_all_frequencies():
    """With an error of the model it does not: its inertia is that of its own model."""
    torque = follower(fj.control.ComputedTorque)
    assert bandwidth(closed_loop(PENDULUM, POSITION, torque, joint=1)) == np.inf
    light = PENDULUM.replace(mass=[0.5], inertia=[0.1])
    torque = follower(fj.control.ComputedTorque, model=light)
    following = closed_loop(PENDULUM, POSITION, torque, joint=1)
    believed, fall = 0.1 + 0.5 * (0.6**2 + 0.2**2), 0.25 * FALL

    def response(s):
        gained = believed * (s**2 + 6 * s + 90)
        return gained / (INERTIA * s**2 + believed * (6 * s + 90) + FALL - fall)

    np.testing.assert_allclose(bandwidth(following), bandwidth_of(response), rtol=1e-9)


@pytest.mark.slow
def test_joints_follow_while_others_hold():
    """Each of three joints under computed torque moves as if it were alone."""
    linkage, q = arm("RPR")
    torque = fj.control.ComputedTorque(90.0, 6.0, np.inf, Stand(q))
    for joint in (1, 2, 3):
        following = closed_loop(linkage, q, torque, joint)
        s = 1j * np.array([0.0, 1.0, 30.0, 1e3])
        np.testing.assert_allclose(following(s), 1, rtol=1e-8)


def test_a_controller_without_a_reference_has_no_bandwidth():
    plain = lambda t, q, qd, linkage: -90 * (q - 0.8) - 6 * qd
    assert np.isfinite(margins(open_loop(PENDULUM, POSITION, plain, joint=1))).all()
    assert np.isnan(bandwidth(closed_loop(PENDULUM, POSITION, plain, joint=1)))
