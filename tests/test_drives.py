"""Servo drives: closed forms, limits, and the states that they integrate."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT, Hold
from scipy.linalg import expm

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

# The joints do not affect each other: slides at right angles carry point masses.
STILL = fj.State(np.zeros(3), np.zeros(3))


def single(inertia=2.0):
    """Returns an arm whose last joint turns a balanced wheel: I qdd = tau."""
    return fj.Linkage(
        "RRR", length=[0, 1, 1, 0], com=[[0, 0]] * 3, mass=[1, 1, 1],
        inertia=[1e6, 1e6, inertia], gravity=0.0,
    )  # fmt: skip


def only_last(value):
    return jnp.array([0.0, 0.0, value])


class Reversed(eqx.Module):
    """A command to the last joint, reversed at a time; all motors share a program."""

    value: jax.Array
    at: jax.Array

    def __call__(self, t, q, qd, linkage):
        return only_last(jnp.where(t < self.at, self.value, -self.value))


def command(value, at=np.inf):
    return Reversed(jnp.asarray(value), jnp.asarray(at))


def test_a_lag_is_an_exponential():
    lag = fj.control.FirstOrderLag(fj.JointEffort([0, 0, 3.0]), 0.2)
    ts = np.linspace(0, 1, 11)
    solution = fj.simulate(single(), STILL, ts, (lag,))
    effort = solution.own[0].own
    np.testing.assert_allclose(effort[:, 2], 3 * (1 - np.exp(-ts / 0.2)), atol=1e-9)
    # tau = 3 (1 - e^(-t/T)) on an inertia of 2, hardly affected by the rest of the arm.
    rate = 1.5 * (ts - 0.2 * (1 - np.exp(-ts / 0.2)))
    np.testing.assert_allclose(solution.qd[:, 2], rate, rtol=3e-6, atol=1e-9)
    found = fj.joint_efforts(single(), (lag,), solution)
    np.testing.assert_array_equal(found.total, effort)
    started = fj.control.FirstOrderLag(fj.JointEffort([0, 0, 3.0]), 0.2, start=2.0)
    np.testing.assert_array_equal(started.initial_state(single()).own, np.full(3, 2.0))


def test_a_motor_reaches_its_current_and_its_speed():
    motor = fj.control.DCMotor(
        command(12.0), resistance=2.0, inductance=0.5, constant=0.1, gear=3.0
    )
    wheel = single()
    # L di/dt = v - R i - k n w, J dw/dt = k n i.
    rates = np.array([[-2 / 0.5, -0.3 / 0.5], [0.3 / 2, 0]])
    ts = np.linspace(0, 5, 21)
    steady = np.linalg.solve(rates, [-12 / 0.5, 0])
    exact = np.array([steady - expm(rates * t) @ steady for t in ts])
    solution = fj.simulate(wheel, STILL, ts, (motor,))
    np.testing.assert_allclose(
        solution.own[0].own[:, 2], exact[:, 0], rtol=1e-5, atol=1e-5
    )
    np.testing.assert_allclose(solution.qd[:, 2], exact[:, 1], rtol=1e-5, atol=1e-5)


def test_a_motor_s_limits():
    options = dict(resistance=2.0, inductance=0.01, constant=0.1)
    ts = np.linspace(0, 0.2, 21)
    low = fj.control.DCMotor(command(100.0), voltage_limit=4.0, **options)
    current = fj.simulate(single(), STILL, ts, (low,)).own[0].own[:, 2]
    assert current.max() == pytest.approx(2.0, rel=1e-2)  # V / R, less the back-EMF


def test_currents_stay_within_their_limit():
    """Covers many windings and a reversed command; i' = (limit - i) R/L."""
    ts = np.linspace(0, 0.2, 41)

    def current(resistance, limit):
        motor = fj.control.DCMotor(
            command(100.0, 0.1), resistance=resistance, inductance=0.01, constant=0.1,
            current_limit=limit,
        )  # fmt: skip
        return fj.simulate(single(), STILL, ts, (motor,)).own[0].own[:, 2]

    resistances = np.linspace(1.5, 2.5, 21)
    currents = np.array([current(r, 3.0) for r in resistances])
    assert np.abs(currents).max() <= 3 + 1e-9
    for row, resistance in zip(currents, resistances):
        exact = 3 * (1 - np.exp(-resistance / 0.01 * ts[:20]))
        np.testing.assert_allclose(row[:20], exact, atol=1e-8)
        assert row[-1] < -2.99
    forward = lambda limit: current(2.0, limit)[19]
    slope = (forward(3.001) - forward(2.999)) / 0.002
    np.testing.assert_allclose(slope, 1 - np.exp(-200 * ts[19]), rtol=1e-6)


def test_a_speed_limit_is_a_line():
    drive = fj.control.SpeedLimit(
        fj.JointEffort([9.0, 9.0, -9.0]), stall=6.0, no_load=2.0
    )
    q = np.zeros(3)
    for qd, expected in (
        ([0, 0, 0], [6, 6, -6]),
        ([1, -1, 1], [3, 6, -6]),
        ([3, -3, -1], [0, 6, -3]),
    ):
        state = drive.initial_state(single())
        tau, _ = drive(0.0, q, np.array(qd, float), single(), state)
        np.testing.assert_allclose(tau, expected)


def test_an_integral_removes_the_sag():
    arm = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 1],
        inertia=[1 / 12] * 3,
    )  # fmt: skip
    hold = Hold(jnp.array([0.3, 0.2, 0.1]))
    start = fj.State(np.zeros(3), np.zeros(3))
    pd = fj.control.PIDController(200.0, 0.0, 40.0, jnp.inf, hold)  # see below
    pid = fj.control.PIDController(200.0, 300.0, 40.0, jnp.inf, hold)
    ends = [
        np.abs(fj.simulate(arm, start, [0, 15], (f,)).q[-1] - hold.target).max()
        for f in (pd, pid)
    ]
    assert ends[0] > 0.05 and ends[1] < 1e-4
    solution = fj.simulate(arm, start, [0, 15], (pid,))
    load = fj.inverse_dynamics(arm, hold.target, np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(solution.own[0][-1], load, atol=0.05)


def test_anti_windup_keeps_the_overshoot_small():
    """The step saturates for so long that a plain integral would wind up."""

    class WindsUp(fj.forces.StatefulElement):
        """The PID controller without anti-windup."""

        pid: fj.control.PIDController

        def initial_state(self, linkage):
            return self.pid.initial_state(linkage)

        def __call__(self, t, q, qd, linkage, state):
            effort, _ = self.pid(t, q, qd, linkage, state)
            return effort, self.pid.ki * (self.pid.pd.reference(t, linkage)[0] - q)

    pid = fj.control.PIDController(8.0, 2.0, 6.0, 1.0, Hold(only_last(3.0)))
    ts = np.linspace(0, 30, 301)
    motions = [fj.simulate(single(), STILL, ts, (f,)) for f in (WindsUp(pid), pid)]
    wild, calm = (float(m.q[:, 2].max() - 3) for m in motions)
    assert wild > 0.3 and calm < 0.3 * wild
    np.testing.assert_allclose(motions[1].q[-1, 2], 3, atol=1e-2)


def test_without_an_integral_it_is_the_pd_controller():
    """Also holds at the limits; an integral of zero stays zero."""
    hold = Hold(only_last(1.0))
    pd = fj.PDController(8.0, 6.0, 1.0, hold)
    pid = fj.control.PIDController(8.0, 0.0, 6.0, 1.0, hold)
    state = pid.initial_state(single())
    assert not np.any(state)
    for at in 0.1 * np.random.default_rng(0).normal(size=(9, 2, 3)):
        effort, rate = pid(0.0, *at, single(), state)
        np.testing.assert_allclose(effort, pd(0.0, *at, single()), atol=1e-12)
        assert not np.any(rate)


def test_drives_in_a_row():
    """A PID controller's torque passes a lag and a speed limit, all with states."""
    pid = fj.control.PIDController(8.0, 2.0, 6.0, 10.0, Hold(only_last(1.0)))
    drive = fj.control.SpeedLimit(
        fj.control.FirstOrderLag(pid, 0.05), stall=5.0, no_load=3.0
    )
    ts = np.linspace(0, 20, 21)
    solution = fj.simulate(single(), STILL, ts, (drive,), **SHORT)
    state = solution.own[0]
    assert state.own == () and state.command.own.shape == (21, 3)
    assert np.abs(state.command.command[:, 2]).max() > 0.1
    np.testing.assert_allclose(solution.q[-1, 2], 1, atol=1e-2)


def test_a_motion_goes_on_from_its_states():
    lag = fj.control.FirstOrderLag(fj.JointEffort([0, 0, 3.0]), 0.2)
    whole = fj.simulate(single(), STILL, [0, 0.5, 1.0], (lag,))
    half = fj.State(whole.q[1], whole.qd[1])
    own = jax.tree.map(lambda rows: rows[1], whole.own)
    rest = fj.simulate(single(), half, [0.5, 1.0], (lag,), own0=own)
    np.testing.assert_allclose(rest.q[-1], whole.q[-1], atol=1e-9)
    with pytest.raises(ValueError, match="own0: expected the states of"):
        fj.simulate(single(), half, [0.5, 1.0], (), own0=own)
    with pytest.raises(ValueError, match="solution.own: expected the states of"):
        fj.joint_efforts(single(), (), whole)


def test_a_state_that_is_not_a_number_is_told():
    lag = fj.control.FirstOrderLag(fj.JointEffort([0, 0, 3.0]), 0.2)
    own0 = jax.tree.map(lambda x: jnp.nan * x, (lag.initial_state(single()),))
    solution = fj.simulate(single(), STILL, [0, 1.0], (lag,), own0=own0, throw=False)
    assert str(solution.outcome) == "not finite"
    assert int(solution.stats["num_steps"]) < 100
    broken = eqx.tree_at(lambda x: x.start, lag, jnp.full(3, jnp.nan))
    with pytest.raises(ValueError, match=r"forces\[0\]\.start: expected .* finite"):
        fj.simulate(single(), STILL, [0, 1.0], (broken,), throw=False)


def test_states_of_elements_are_swept():
    lag = fj.control.FirstOrderLag(fj.JointEffort([0, 0, 3.0]), 0.2)
    q = np.linspace(0, 1, 5)[:, None] * np.ones(3)
    starts, ts = fj.State(q, np.zeros(3)), [0, 0.2, 0.4]
    solution = fj.sweep(single(), starts, ts, (lag,), solver=LoopedDopri8())
    effort = solution.own[0].own
    exact = 3 * (1 - np.exp(-np.array([0, 1, 2])))
    np.testing.assert_allclose(effort[..., 2], np.tile(exact, (5, 1)), atol=1e-9)


class Wrong(fj.forces.StatefulElement):
    """An element whose rate has another shape than its state."""

    def initial_state(self, linkage):
        return jnp.zeros(3)

    def __call__(self, t, q, qd, linkage, state):
        return jnp.zeros(3), jnp.zeros(2)


def test_malformed_elements_are_refused():
    with pytest.raises(
        ValueError, match=r"forces\[0\]: expected the rate of its state"
    ):
        fj.simulate(single(), STILL, [0, 1], (Wrong(),))
    with pytest.raises(ValueError, match="command: expected a force element"):
        fj.control.FirstOrderLag(3.0, 0.1)
    short = fj.control.FirstOrderLag(lambda t, q, qd, linkage: 5.0, 0.1)
    with pytest.raises(ValueError, match="command: expected an array of 3"):
        fj.simulate(single(), STILL, [0, 1], (short,))
    with pytest.raises(ValueError, match="ki: expected 0 where kp is"):
        fj.control.PIDController([1, 1, 0.0], 1.0, 1.0, 1.0, Hold(only_last(1.0)))
    with pytest.raises(ValueError, match="time_constant: expected .* above 0"):
        fj.control.FirstOrderLag(fj.JointEffort(np.ones(3)), 0.0)
    with pytest.raises(ValueError, match="resistance: expected"):
        fj.control.DCMotor(
            fj.JointEffort(np.ones(3)), resistance=-1, inductance=1, constant=1
        )
