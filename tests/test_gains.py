"""Gains from frequencies, and loops: closed forms, poles, python-control."""

import control
import equinox as eqx
import numpy as np
import pytest
from helpers import random_linkage
from matplotlib.figure import Figure

import fdof_jax as fj

PENDULUM = fj.Linkage(
    "R", length=[0, 1], com=[[0.6, 0.2]], mass=[2], inertia=[0.3], gravity=9.81
)
STILL = np.zeros(3)


class Stand(fj.references.Reference):
    target: fj.Values = fj.field(unit="m or rad")

    def __call__(self, t, linkage):
        return self.target, 0 * self.target


def arm(topology, seed=0):
    rng = np.random.default_rng(seed)
    return random_linkage(topology, rng), rng.uniform(-1, 1, 3)


def pd_at(q, kp, kd):
    n = len(q)
    full = lambda value: np.broadcast_to(value, n).astype(float)
    return fj.PDController(full(kp), full(kd), full(np.inf), Stand(q))


def poles(linkage, q, *forces):
    A, _ = fj.linearize(linkage, fj.State(q, 0 * q), forces)
    return np.linalg.eigvals(A)


def state_space(loop):
    return control.ss(loop.A, loop.B[:, None], loop.C[None], 0)


# Gains from frequencies


@pytest.mark.parametrize("joint", range(3))
def test_a_joint_that_moves_alone_has_the_frequency_and_the_damping(joint):
    linkage, q = arm("RRR")
    linkage = linkage.replace(gravity=0, locked=0)
    frequency, ratio = np.array([3.0, 5.0, 8.0]), np.array([0.2, 0.7, 1.0])
    gains = fj.control.gains_from_frequency(linkage, q, frequency, ratio)
    others = "".join("R" if k == joint else "F" for k in range(3))
    alone = linkage.replace(topology=others, locked=q)
    found = poles(alone, q, pd_at(q, *gains))
    omega, zeta = frequency[joint], ratio[joint]
    expected = np.roots([1, 2 * zeta * omega, omega**2])
    found = found[np.abs(found) > 1e-6]  # without those of the fixed pairs
    np.testing.assert_allclose(np.poly(found), np.poly(expected), rtol=1e-9)
    fixed = fj.control.gains_from_frequency(alone, q, frequency, ratio)
    np.testing.assert_allclose(fixed, np.eye(3)[joint] * gains, rtol=1e-12)


def test_gains_count_masses_of_elements():
    linkage, q = arm("RPR")
    bare = fj.control.gains_from_frequency(linkage, q, 4.0, 0.5)
    geared = fj.control.gains_from_frequency(
        linkage, q, 4.0, 0.5, (fj.forces.Armature([1.0, 2.0, 3.0]),)
    )
    more = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(geared[0] - bare[0], 16 * more, rtol=1e-12)
    np.testing.assert_allclose(geared[1] - bare[1], 4 * more, rtol=1e-12)


def test_a_joint_under_computed_torque_has_the_frequency_itself():
    linkage, q = arm("PRR")
    omega, zeta = 6.0, 0.4
    torque = fj.control.ComputedTorque(omega**2, 2 * zeta * omega, np.inf, Stand(q))
    expected = np.roots([1, 2 * zeta * omega, omega**2])
    found = poles(linkage, q, torque)
    np.testing.assert_allclose(np.abs(found), np.abs(expected[0]), rtol=1e-6)


@pytest.mark.parametrize(
    "frequency, ratio, message",
    [
        ([1, 2], 1, "frequency: expected an array of 3 real numbers for 3 joints"),
        (0, 1, r"frequency: .* above 0 \[rad/s\]"),
        (1, -0.1, "damping_ratio: .* at least 0"),
    ],
)
def test_impossible_frequencies_are_refused(frequency, ratio, message):
    linkage, q = arm("RRR")
    with pytest.raises(ValueError, match=message):
        fj.control.gains_from_frequency(linkage, q, frequency, ratio)


# Loops


def test_the_loop_of_a_pendulum_is_as_written_out():
    q, kp, kd = np.array([0.8]), 50.0, 6.0
    loop = fj.analysis.open_loop(PENDULUM, q, pd_at(q, kp, kd), joint=1)
    inertia = 0.3 + 2 * (0.6**2 + 0.2**2)
    fall = -2 * 9.81 * (0.6 * np.sin(q[0]) + 0.2 * np.cos(q[0]))
    s = 1j * np.geomspace(0.1, 100, 7)
    expected = (kp + kd * s) / (inertia * s**2 + fall)
    np.testing.assert_allclose(loop(np.abs(s)), expected, rtol=1e-10)
    assert loop.stable and loop.joint == "R1"
    # It falls over if the gains are too low.
    np.testing.assert_allclose(loop.gain_margin, -fall / kp, rtol=1e-9)
    # |kp + kd s|^2 = (inertia w^2 - fall)^2
    squares = np.roots([inertia**2, -2 * inertia * fall - kd**2, fall**2 - kp**2])
    crossover = np.sqrt(squares.max())
    np.testing.assert_allclose(loop.crossover, crossover, rtol=1e-9)
    margin = np.arctan(kd * crossover / kp)
    np.testing.assert_allclose(loop.phase_margin, margin, rtol=1e-9)
    np.testing.assert_allclose(loop.delay_margin, margin / crossover, rtol=1e-9)


def test_without_gravity_the_loop_is_infinite_at_rest():
    q = np.array([0.8])
    weightless = PENDULUM.replace(gravity=0)
    loop = fj.analysis.open_loop(weightless, q, pd_at(q, 50.0, 6.0), joint=1)
    assert np.isinf(loop(0.0)) and np.isfinite(loop([0.0, 1.0])[1])
    assert loop.stable and loop.gain_margin == np.inf


def test_a_controller_at_its_limit_has_no_loop():
    q = np.array([0.8])
    pd = pd_at(q + 1, 50.0, 6.0)
    limited = fj.PDController(pd.kp, pd.kd, [10.0], pd.reference)
    loop = fj.analysis.open_loop(PENDULUM, q, limited, joint=1)
    assert (loop([1.0, 2.0]) == 0).all() and not loop.stable  # it falls
    assert np.isnan(loop.crossover) and np.isnan(loop.bandwidth)
    assert "no response: at its limit" in str(loop) and "margin  " not in str(loop)
    # No change of the loop makes an arm unstable that hangs.
    hangs = fj.analysis.open_loop(PENDULUM, q - np.pi, limited, joint=1)
    hangs = eqx.tree_at(lambda loop: loop.A, hangs, hangs.A - 0.1 * np.eye(2))
    assert hangs.stable and "no response: at its limit" in str(hangs)
    assert hangs.phase_margin == hangs.gain_margin == hangs.delay_margin == np.inf
    assert hangs.modulus_margin == 1
    above, _ = fj.plotting.bode_plot(loop, Figure()).axes
    assert [line.get_label() for line in above.lines] == ["loop of R1", "|L| = 1"]
    with pytest.raises(ValueError, match="loop: expected an OpenLoop"):
        fj.plotting.bode_plot(limited)


@pytest.mark.parametrize("kp, kd", [(1.0, 1.0), (50.0, 0.0)])
def test_a_loop_that_is_not_stable_has_no_margins(kp, kd):
    """It falls, as its gains are too low, or swings without end."""
    q = np.array([0.8])
    loop = fj.analysis.open_loop(PENDULUM, q, pd_at(q, kp, kd), joint=1)
    margins = loop.phase_margin, loop.delay_margin, loop.gain_margin
    assert np.isnan([*margins, loop.modulus_margin]).all() and not loop.stable
    text = "  closed loop     not stable, so it has no margins"
    assert str(loop).splitlines() == ["loop of R1", text]
    for ax in fj.plotting.bode_plot(loop, Figure()).axes:
        assert len(ax.lines) == 2 and np.isfinite(ax.lines[0].get_ydata()).all()


@pytest.mark.parametrize("topology", ["RPR", "RRR"])
@pytest.mark.parametrize("lagged", [False, True])
def test_margins_agree_with_python_control(topology, lagged):
    linkage, q = arm(topology)
    gains = fj.control.gains_from_frequency(linkage, q, [8.0, 20.0, 60.0], 0.7)
    controller = pd_at(q, *gains)
    if lagged:
        controller = fj.control.FirstOrderLag(controller, 0.004)
    for joint in (1, 2, 3):
        loop = fj.analysis.open_loop(linkage, q, controller, joint)
        assert loop.stable
        system = state_space(loop)
        gain, phase, modulus, *_, crossover, _ = control.stability_margins(system)
        gain = gain if gain < 1e6 else np.inf  # a zero at infinity, rounded
        np.testing.assert_allclose(loop.gain_margin, gain, rtol=1e-6)
        np.testing.assert_allclose(np.rad2deg(loop.phase_margin), phase, rtol=1e-6)
        np.testing.assert_allclose(loop.crossover, crossover, rtol=1e-6)
        np.testing.assert_allclose(loop.modulus_margin, min(modulus, 1), rtol=1e-6)
        margins = control.stability_margins(system, returnall=True)
        phases, crossings = margins[1], margins[4]
        delays = np.deg2rad(phases % 360) / crossings
        np.testing.assert_allclose(loop.delay_margin, delays.min(), rtol=1e-6)
        closed = control.ss(system.A - system.B @ system.C, system.B, system.C, 0)
        expected = control.bandwidth(closed)
        np.testing.assert_allclose(loop.bandwidth, expected, rtol=1e-4)
        w = np.geomspace(1, 100, 5)
        np.testing.assert_allclose(loop(w), system(1j * w), rtol=1e-9)


def loops_of_slow_drives():
    """Returns loops whose phase falls below -180 degrees, one per joint."""
    linkage, q = arm("RPR")
    gains = fj.control.gains_from_frequency(linkage, q, [8.0, 20.0, 60.0], 0.7)
    controller = pd_at(q, *gains)
    for time_constant in (0.004, 0.002):
        controller = fj.control.FirstOrderLag(controller, time_constant)
    return [fj.analysis.open_loop(linkage, q, controller, k) for k in (1, 2, 3)]


def test_at_the_gain_margin_the_closed_loop_becomes_unstable():
    for loop in loops_of_slow_drives():
        margin = loop.gain_margin
        decay = lambda factor, loop=loop: np.linalg.eigvals(
            loop.A - factor * np.outer(loop.B, loop.C)
        ).real.max()
        assert loop.stable and margin < 100
        nearer, beyond = margin ** np.array([0.999, 1.001])
        assert decay(nearer) < 0 < decay(beyond)


def test_a_bode_plot_agrees_with_python_control():
    for loop in loops_of_slow_drives():
        fig = fj.plotting.bode_plot(loop, Figure())
        gain_margin, level, _ = fig.axes[0].lines
        phase_margin, phase, _ = fig.axes[1].lines
        frequency = level.get_xdata()
        expected = control.frequency_response(state_space(loop), frequency)
        decibel = 20 * np.log10(expected.magnitude)
        np.testing.assert_allclose(level.get_ydata(), decibel, atol=1e-6)
        turns = (phase.get_ydata() - np.rad2deg(expected.phase)) / 360
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-6)
        assert np.abs(np.diff(phase.get_ydata())).max() < 180
        with np.errstate(over="ignore"):  # of its polynomials
            margins = control.stability_margins(state_space(loop))
        gain, degrees, _, at_gain, at_phase, _ = margins
        np.testing.assert_allclose(gain_margin.get_xdata(), at_gain, rtol=0.02)
        np.testing.assert_allclose(phase_margin.get_xdata(), at_phase, rtol=1e-6)
        decibel = 20 * np.log10(gain)
        np.testing.assert_allclose(gain_margin.get_ydata(), [0, -decibel], atol=1e-6)
        ends = [-180, degrees - 180]
        np.testing.assert_allclose(phase_margin.get_ydata(), ends, atol=1e-4)
        at = np.interp(at_phase, frequency, phase.get_ydata())
        np.testing.assert_allclose(at, degrees - 180, atol=0.1)


def test_a_bode_plot_shows_narrow_peaks():
    """Those of the other joints' modes, of which the phase turns by half a turn."""
    linkage, q = arm("RRR")
    linkage = linkage.replace(gravity=0)
    gains = fj.control.gains_from_frequency(linkage, q, [8, 20, 60], 1e-4)
    loop = fj.analysis.open_loop(linkage, q, pd_at(q, *gains), 1)
    fig = fj.plotting.bode_plot(loop, Figure())
    level = next(x for x in fig.axes[0].lines if x.get_label() == "loop of R1")
    frequency, shown = level.get_xdata(), level.get_ydata()
    modes = np.linalg.eigvals(loop.A)
    for mode in modes[modes.imag > 1]:
        near = np.abs(frequency - mode.imag) < 2 * np.abs(mode.real)
        peak = 20 * np.log10(np.abs(loop(mode.imag)))
        assert shown[near].max() > peak - 0.1
    free = pd_at(q, gains[0], 0 * gains[1])  # where L is infinite at the others' modes
    undamped = fj.analysis.open_loop(linkage, q, free, 1)
    for ax in fj.plotting.bode_plot(undamped, Figure()).axes:
        assert all(np.isfinite(line.get_ydata()).all() for line in ax.lines)


def test_the_closed_loop_is_the_linearised_arm():
    linkage, q = arm("RPR")
    gains = fj.control.gains_from_frequency(linkage, q, 20.0, 0.7)
    load = fj.analysis.holding_efforts(linkage, q)
    pd = pd_at(q + load / gains[0], *gains)  # sags to q
    loop = fj.analysis.open_loop(linkage, q, pd, joint=2)
    found = np.poly(loop.A - np.outer(loop.B, loop.C))
    np.testing.assert_allclose(found, np.poly(poles(linkage, q, pd)), rtol=1e-9)
    # Constant efforts hold what a controller without its load would not.
    other = fj.analysis.open_loop(linkage, q, pd_at(q, *gains), joint=2)
    np.testing.assert_allclose(other.A, loop.A, rtol=1e-12)


def test_pid_and_fixed_pairs_have_loops():
    q = np.array([0.8, 0.0])
    longer = fj.Linkage(
        "RF", length=[0, 1, 1], com=[[0.6, 0.2], [0.5, 0]], mass=[2, 1],
        inertia=[0.3, 0.1],
    )  # fmt: skip
    pid = fj.control.PIDController(80.0, 40.0, 9.0, np.inf, Stand(q))
    loop = fj.analysis.open_loop(longer, q, pid, joint=1)
    assert loop.stable
    inertia = fj.mass_matrix(longer, q)[0, 0]
    # At high frequencies the plant is an inertia alone.
    np.testing.assert_allclose(abs(loop(1e5)) * 1e5, 9.0 / inertia, rtol=1e-6)
    assert abs(loop(1e-6)) > 1e6  # the integral leaves no error
    with pytest.raises(ValueError, match=r"joint: expected one of \(1,\), got 2"):
        fj.analysis.open_loop(longer, q, pid, joint=2)
    # The integral of a joint without a gain of it stands still, as its fixed pair.
    one = fj.control.PIDController(80.0, [40.0, 0.0], 9.0, np.inf, Stand(q))
    loop = fj.analysis.open_loop(longer.replace(topology="RR"), q, one, joint=1)
    assert loop.stable and loop.A.shape == (5, 5)


def test_a_loop_is_shown():
    q = np.array([0.8])
    loop = fj.analysis.open_loop(PENDULUM, q, pd_at(q, 50.0, 6.0), joint=1)
    degrees = f"{np.rad2deg(loop.phase_margin):.4g} degrees"
    assert str(loop).startswith("loop of R1") and degrees in str(loop)
    assert f"<tr><th>phase margin</th><td>{degrees}</td></tr>" in loop._repr_html_()


def test_loops_of_malformed_arguments_are_refused():
    linkage, q = arm("RRR")
    pd = pd_at(q, 1.0, 1.0)
    for controller, joint, forces, message in [
        (pd, 0, (), r"joint: expected one of \(1, 2, 3\), got 0"),
        (pd, 1, (fj.control.FirstOrderLag(pd, 0.1),), "forces: expected elements"),
        (3.0, 1, (), "controller: expected a force element"),
        (
            fj.simulation.PrescribedMotion(1, pd.reference),
            1,
            (),
            "controller: expected one that",
        ),
    ]:
        with pytest.raises(ValueError, match=message):
            fj.analysis.open_loop(linkage, q, controller, joint, forces)
