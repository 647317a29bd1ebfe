"""Loops of controllers: closed forms, margins, and how joints follow references."""

import control
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from test_control import PENDULUM, Stand, arm, pd_at

import fdof_jax as fj
from fdof_jax.analysis import bandwidth, closed_loop, margins, open_loop

# A pendulum's inertia about its pivot, and the slope of its weight, at 0.8 rad.
INERTIA = 0.3 + 2 * (0.6**2 + 0.2**2)
FALL = -2 * 9.81 * (0.6 * np.sin(0.8) + 0.2 * np.cos(0.8))
POSITION = np.array([0.8])
FREQUENCIES = 1j * np.geomspace(0.1, 1e3, 9)

# Margins of systems of python-control


def coupled(frequency, ratio, joint, lag=0.0):
    """Returns the loop of one of three coupled joints; those of the others stay."""
    mass = np.array([[3, 1, 0.5], [1, 2, 0.3], [0.5, 0.3, 1]])
    kp = np.diag(mass) * np.square(frequency)
    kd = 2 * ratio * np.diag(mass) * frequency
    row = np.zeros((1, 6))
    row[0, [joint, joint + 3]] = kp[joint], kd[joint]
    column = np.append(np.zeros(3), np.linalg.inv(mass)[joint])[:, None]
    slopes = -np.linalg.solve(mass, np.hstack([np.diag(kp), np.diag(kd)]))
    A = np.vstack([np.eye(3, 6, 3), slopes]) + column @ row
    loop = control.ss(A, column, row, 0)
    return loop * control.ss(-1 / lag, 1 / lag, 1, 0) if lag else loop


def stiff(kp=185270.0, ki=3800916.0, kd=455.15, lag=4.8744e-4, fall=0.55):
    """Returns the loop of PID control of an inertia of 4.4 behind a lag."""
    A = np.array([
        [0, 1, 0, 0], [fall / 4.4, 0, 0, 0],
        [-kp / lag, -kd / lag, -1 / lag, 1 / lag], [-ki, 0, 0, 0],
    ])  # fmt: skip
    return control.ss(A, [[0], [1 / 4.4], [0], [0]], [[0, 0, -1, 0]], 0)


LOOPS = {
    "with a lag": coupled([8, 22, 60], 0.7, 2, 4e-3),
    "of unlike joints": coupled([8, 80, 800], 0.7, 0, 1e-4),
    # Peaks are narrower than samples of the frequency are apart.
    "lightly damped": coupled([8, 8.8, 60], 5e-4, 0),
    "stiff": stiff(),
    # L = 2 s / (s + 1) leads by 60 degrees where |L| = 1.
    "leading": control.ss(-1, 1, -2, 2),
}


@pytest.mark.parametrize("name", LOOPS)
def test_loops_are_unstable_beyond_their_margins(name):
    loop = LOOPS[name]
    found, through = margins(loop), loop.D[0, 0]
    closed = lambda k: loop.A - k / (1 + k * through) * loop.B @ loop.C
    decay = lambda k: np.linalg.eigvals(closed(k)).real.max()
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
        found = minimize_scalar(distance, bounds=ends, options=dict(xatol=1e-9))
        least.append(found.fun)
    return min(least)


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


def test_the_bandwidth_ends_at_a_narrow_dip():
    """The dip of another joint's mode, between samples of the frequency."""
    response = coupled([8, 8.8, 60], 5e-4, 2).feedback()
    edge = bandwidth(response)
    below, above = np.abs(response(1j * edge * np.array([1 - 1e-6, 1 + 1e-6])))
    assert above < 10 ** (-3 / 20) < below
    assert control.bandwidth(response) > 3 * edge
    assert bandwidth(control.ss(-1, 0, 0, 1)) == np.inf  # of what follows at once


# Loops of arms


def test_the_loop_of_a_pendulum_is_as_written_out():
    kp, kd = 50.0, 6.0
    loop = open_loop(PENDULUM, POSITION, pd_at(POSITION, kp, kd), joint=1)
    s = FREQUENCIES
    expected = (kp + kd * s) / (INERTIA * s**2 + FALL)
    np.testing.assert_allclose(loop(s), expected, rtol=1e-10)
    assert loop.name == "loop of R1"
    # It falls over if the gains are too low. |kp + kd s|^2 = (inertia w^2 - fall)^2
    squares = np.roots([INERTIA**2, -2 * INERTIA * FALL - kd**2, FALL**2 - kp**2])
    crossover = np.sqrt(squares.max())
    phase = np.arctan(kd * crossover / kp)
    found = margins(loop)._replace(modulus=0)
    expected = -FALL / kp, phase, phase / crossover, 0, crossover
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_loops_without_margins_have_none():
    # Without gravity, where L is infinite at rest, no factor makes it unstable.
    weightless = PENDULUM.replace(gravity=0)
    loop = open_loop(weightless, POSITION, pd_at(POSITION, 50, 6), joint=1)
    assert margins(loop).gain == np.inf
    # Loops are not stable that fall, as gains are too low, or swing without end.
    for gains in ((1.0, 1.0), (50.0, 0.0)):
        loop = open_loop(PENDULUM, POSITION, pd_at(POSITION, *gains), joint=1)
        assert np.isnan(margins(loop)).all()
    # A controller at its limit has no loop, and the arm falls.
    limited = pd_at(POSITION + 1, 50, 6).replace(limit=[10.0])
    loop = open_loop(PENDULUM, POSITION, limited, joint=1)
    assert (loop([1j, 2j]) == 0).all() and np.isnan(margins(loop)).all()
    plain = lambda t, q, qd, linkage: -90 * (q - 0.8) - 6 * qd  # without a reference
    for controller in (limited, plain):
        assert np.isnan(bandwidth(closed_loop(PENDULUM, POSITION, controller, 1)))
    # No change of the loop makes what is stable without it unstable.
    hangs = margins(control.ss([[0, 1], [-1, -1]], [[0], [1]], [[0, 0]], 0))
    assert hangs.phase == hangs.gain == hangs.delay == np.inf and hangs.modulus == 1


@pytest.mark.slow
def test_a_joint_follows_while_the_loops_of_others_stay_closed():
    linkage, q, s = *arm("RP"), FREQUENCIES
    q, loads = q[:2], fj.analysis.holding_efforts(linkage, q[:2])
    kp, kd = fj.control.gains_from_frequency(linkage, q, 20.0, 0.7)
    # Constant efforts hold what a controller without its load would not.
    slopes = lambda at: open_loop(linkage, q, pd_at(at, kp, kd), 2).A
    np.testing.assert_allclose(slopes(q), slopes(q + loads / kp), rtol=1e-12)
    light, pd = linkage.replace(gravity=0), pd_at(q, kp, kd)
    mass, push = np.asarray(fj.mass_matrix(light, q)), np.diag([0, 1])
    both = lambda s: np.diag(kp + kd * s)
    expected = [np.linalg.solve(mass * s**2 + both(s), both(s) @ push)[1, 1] for s in s]
    around = open_loop(light, q, pd, 2).feedback()
    for response in around, closed_loop(light, q, pd, 2):
        np.testing.assert_allclose(response(s), expected, rtol=1e-8)


@pytest.mark.slow
def test_integrals_of_no_gain_or_of_a_fixed_pair_within_a_drive_are_no_states():
    """The latter integrates without end, but acts on nothing that moves."""
    q, s = np.append(POSITION, 0.0), FREQUENCIES

    def loop_of(kinds, mass, inertia):
        masses = dict(mass=[2.0, mass], inertia=[0.3, inertia])
        places = dict(length=[0, 1, 0], com=[[0.6, 0.2], [0.0, 0]])
        linkage = fj.Linkage(kinds, **places, **masses)
        pid = fj.control.PIDController([80.0, 5], [40.0, 0], 9.0, np.inf, Stand(q))
        drive = fj.control.SpeedLimit(pid, stall=1e3, no_load=1e3)
        return open_loop(linkage, q, fj.control.FirstOrderLag(drive, 0.002), joint=1)

    loop = loop_of("RF", 0.0, 0.0)
    assert loop.A.shape == (4, 4) and loop.feedback().poles().real.max() < 0
    expected = (80 + 40 / s + 9 * s) / (0.002 * s + 1) / (INERTIA * s**2 + FALL)
    np.testing.assert_allclose(loop(s), expected, rtol=1e-6)
    assert loop_of("RR", 1.0, 0.1).A.shape == (7, 7)


GAINS = dict(kp=[90.0], kd=[6.0], limit=[np.inf], reference=Stand(POSITION))
LIGHT = PENDULUM.replace(mass=[0.5], inertia=[0.1])
BELIEVED = 0.1 + 0.5 * (0.6**2 + 0.2**2)
PLAIN = lambda t, k: (POSITION, 0 * POSITION)
MOTOR = dict(resistance=1.0, inductance=1e-3, constant=3.0)
# Controllers, and polynomials of the response: numerator and denominator.
FOLLOWERS = {
    "PD of a plain reference": (
        fj.PDController(**GAINS | dict(reference=PLAIN)),
        [6, 90], [INERTIA, 6, 90 + FALL],
    ),
    "gravity feedforward": (
        fj.control.GravityFeedforward(**GAINS), [6, 90], [INERTIA, 6, 90]
    ),
    "PID": (
        fj.control.PIDController(**GAINS, ki=[50.0]),
        [6, 90, 50], [INERTIA, 6, 90 + FALL, 50],
    ),
    # The back-EMF acts on speeds, but not on those of the reference.
    "motor": (
        fj.control.DCMotor(fj.PDController(**GAINS), **MOTOR),
        [18, 270], [1e-3 * INERTIA, INERTIA, 1e-3 * FALL + 9 + 18, FALL + 270],
    ),
    # The inertia of the model acts on the accelerations of the reference.
    "light model": (
        fj.control.ComputedTorque(**GAINS, model=LIGHT),
        BELIEVED * np.array([1, 6, 90]),
        [INERTIA, 6 * BELIEVED, 90 * BELIEVED + 0.75 * FALL],
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLLOWERS)
def test_the_bandwidth_is_that_of_the_response_to_the_reference(name):
    controller, above, below = FOLLOWERS[name]
    response = lambda s: np.polyval(above, s) / np.polyval(below, s)
    following = closed_loop(PENDULUM, POSITION, controller, joint=1)
    np.testing.assert_allclose(following(FREQUENCIES), response(FREQUENCIES), rtol=1e-8)
    edge, whole = bandwidth(following), abs(response(0))
    np.testing.assert_allclose(abs(response(1j * edge)), 10**-0.15 * whole, rtol=1e-8)
    slower = abs(response(1j * np.linspace(0, 0.999 * edge, 999)))
    assert (slower > 10**-0.15 * whole).all()
