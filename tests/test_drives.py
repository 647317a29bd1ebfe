"""Servo drives: closed forms, limits, and the states that they integrate."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT
from helpers import Hold
from scipy.linalg import expm

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

# A balanced wheel: 2 qdd = tau.
WHEEL = fj.Linkage(
    "R", length=[0, 0], com=[[0, 0]], mass=[1], inertia=[2.0], gravity=0.0
)
STILL = fj.State(np.zeros(1), np.zeros(1))
LAG = fj.control.FirstOrderLag(fj.JointEffort([3.0]), 0.2)


class Reversed(eqx.Module):
    """A command that is reversed at a time; all motors share a program."""

    value: jax.Array
    at: jax.Array

    def __call__(self, t, q, qd, linkage):
        return jnp.where(t < self.at, self.value, -self.value)[None]


def command(value, at=np.inf):
    return Reversed(jnp.asarray(value), jnp.asarray(at))


def test_a_lag_is_an_exponential():
    ts = np.linspace(0, 1, 11)
    solution = fj.simulate(WHEEL, STILL, ts, (LAG,))
    effort = solution.own[0].own
    np.testing.assert_allclose(effort[:, 0], 3 * (1 - np.exp(-ts / 0.2)), atol=1e-9)
    rate = 1.5 * (ts - 0.2 * (1 - np.exp(-ts / 0.2)))  # of an inertia of 2
    np.testing.assert_allclose(solution.qd[:, 0], rate, rtol=1e-7, atol=1e-9)
    found = fj.joint_efforts(WHEEL, (LAG,), solution)
    np.testing.assert_array_equal(found.total, effort)
    started = LAG.replace(start=2.0).initial_state(fj.scenes.fig5().linkage)
    np.testing.assert_array_equal(started.own, np.full(3, 2.0))


@pytest.mark.slow
def test_a_motor_reaches_its_current_and_its_speed():
    motor = fj.control.DCMotor(
        command(12.0), resistance=2.0, inductance=0.5, constant=0.1, gear=3.0
    )
    # L di/dt = v - R i - k n w, J dw/dt = k n i.
    rates = np.array([[-2 / 0.5, -0.3 / 0.5], [0.3 / 2, 0]])
    ts = np.linspace(0, 5, 21)
    steady = np.linalg.solve(rates, [-12 / 0.5, 0])
    exact = np.array([steady - expm(rates * t) @ steady for t in ts])
    motion = fj.simulate(WHEEL, STILL, ts, (motor,))
    found = np.hstack([motion.own[0].own, motion.qd])
    np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_currents_stay_within_their_limits():
    """Covers many windings and a reversed command; i' = (limit - i) R/L."""
    ts = np.linspace(0, 0.2, 41)

    def current(resistance, limit, volts=np.inf):
        motor = fj.control.DCMotor(
            command(100.0, 0.1), resistance=resistance, inductance=0.01, constant=0.1,
            current_limit=limit, voltage_limit=volts,
        )  # fmt: skip
        return fj.simulate(WHEEL, STILL, ts, (motor,)).own[0].own[:, 0]

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
    # V / R, less the back-EMF.
    assert current(2.0, np.inf, 4.0).max() == pytest.approx(2.0, rel=1e-2)


# A resistance of 2 ohm, and 0.3 N m/A at the joint.
STATIC = fj.control.DCMotor(command(12.0), resistance=2.0, constant=0.1, gear=3.0)


@pytest.mark.slow
def test_a_motor_without_inductance_runs_up_as_an_exponential():
    decay, top = 0.3**2 / (2 * 2.0), 12 / 0.3  # of an inertia of 2
    ts = np.linspace(0, 100, 11)
    motion = fj.simulate(WHEEL, STILL, ts, (STATIC,))
    assert not jax.tree.leaves(motion.own)
    speed = top * (1 - np.exp(-decay * ts))
    np.testing.assert_allclose(motion.qd[:, 0], speed, rtol=1e-8, atol=1e-9)
    after = fj.step(WHEEL, STILL, [0.0], ts[1], (STATIC,))
    np.testing.assert_allclose(after.qd, motion.qd[1], rtol=1e-8)
    A, B = fj.linearize(WHEEL, STILL, (STATIC,))
    np.testing.assert_allclose(A, [[0, 1], [0, -decay]], atol=1e-14)
    np.testing.assert_allclose(B, [[0], [0.5]], atol=1e-14)


# Commands and speeds in all pairs, to 1.5 times the speed without load at 40 V.
TOP = 40 / 0.3
GRID = np.meshgrid([-1e3, -30.0, -2, 0, 5, 60], TOP * np.linspace(-1.5, 1.5, 13))
COMMANDS, SPEEDS = (rows.ravel() for rows in GRID)


@pytest.mark.parametrize("volts, amps", [(np.inf, np.inf), (40, 3.0), (40, np.inf)])
def test_without_inductance_currents_are_those_at_which_others_would_end(volts, amps):
    motor = STATIC.replace(voltage_limit=volts, current_limit=amps)
    effort, rate = motor.respond(COMMANDS, SPEEDS, ())
    current, back_emf = np.asarray(effort) / 0.3, 0.3 * SPEEDS
    assert rate == ()
    exact = np.clip((COMMANDS - back_emf) / 2, -amps, amps)
    least, most = ((sign * volts - back_emf) / 2 for sign in (-1, 1))
    np.testing.assert_allclose(current, np.clip(exact, least, most), atol=1e-12)
    slow = motor.replace(inductance=0.5)
    same, rate = slow.respond(COMMANDS, SPEEDS, current)
    np.testing.assert_allclose(same, effort, rtol=1e-12)
    np.testing.assert_allclose(rate, 0, atol=1e-11)
    if volts == np.inf:  # the power heats the winding and moves the joint
        power = 2 * current**2 + effort * SPEEDS
        np.testing.assert_allclose(COMMANDS * current, power, rtol=1e-9, atol=1e-9)


def test_an_inductance_is_of_all_joints_or_of_none():
    for zero in (0, [0.0, 0.0], None):
        assert STATIC.replace(inductance=zero).inductance is None
    currents = lambda value: STATIC.replace(inductance=value).initial(WHEEL)
    for value, count in ((0.1, 1), (np.array([0.1]), 1), (0, 0), (jnp.zeros(1), 0)):
        within = jax.jit(lambda value=value: currents(value))
        assert np.size(currents(value)) == np.size(within()) == count
    within = jax.vmap(lambda value: STATIC.replace(inductance=value))(np.zeros(2))
    assert not within.possible()  # while it is traced, it is taken for positive


@pytest.mark.slow
def test_a_speed_limit_in_four_quadrants():
    """Driving, it falls with the speed; braking, the whole effort is left."""
    drive = fj.control.SpeedLimit(fj.JointEffort([1.0]), 6.0, TOP)
    effort, _ = drive.respond(COMMANDS, SPEEDS, ())
    driving = COMMANDS * SPEEDS > 0
    most = 6 * np.where(driving, np.maximum(1 - np.abs(SPEEDS) / TOP, 0), 1)
    exact = np.sign(COMMANDS) * np.minimum(np.abs(COMMANDS), most)
    np.testing.assert_allclose(effort, exact, atol=1e-12)
    # So does a motor at its limits, up to that speed: 40 V and the current of stall.
    motor = STATIC.replace(voltage_limit=40, current_limit=20)
    full = 1e3 * np.sign(COMMANDS)[COMMANDS != 0], SPEEDS[COMMANDS != 0]
    below = np.abs(full[1]) <= TOP
    same, other = (part.respond(*full, ())[0] for part in (motor, drive))
    np.testing.assert_allclose(same[below], other[below], atol=1e-12)
    assert (np.abs(same - other)[~below] > 1).any()


@pytest.mark.parametrize("ki", [0.0, 3.0])
@pytest.mark.parametrize("limit", [0.5, np.inf])
def test_the_integral_adds_to_pd_control_and_is_drained_by_what_is_clipped(ki, limit):
    """At rest it then holds the load, and no error is left."""
    arm, hold = fj.scenes.fig5().linkage, Hold(jnp.array([1.0, 0.5, -0.2]))
    pd = fj.PDController(8.0, 6.0, np.inf, hold)
    pid = fj.control.PIDController(8.0, ki, 6.0, limit, hold)
    assert not np.any(pid.initial_state(arm))
    for q, qd, state in 0.5 * np.random.default_rng(0).normal(size=(9, 3, 3)):
        effort, rate = pid(0.0, q, qd, arm, state)
        demand = np.asarray(pd(0.0, q, qd, arm)) + state
        np.testing.assert_allclose(effort, np.clip(demand, -limit, limit), rtol=1e-12)
        drained = (demand - effort) / 8
        np.testing.assert_allclose(rate, ki * (hold.target - q - drained), atol=1e-12)


@pytest.mark.slow
def test_drives_in_a_row():
    """A PID controller's torque passes a lag and a speed limit, all with states."""
    pid = fj.control.PIDController(8.0, 2.0, 6.0, 10.0, Hold(jnp.array([1.0])))
    lag = fj.control.FirstOrderLag(pid, 0.05)
    drive = fj.control.SpeedLimit(lag, stall=5.0, no_load=3.0)
    motion = fj.simulate(WHEEL, STILL, np.linspace(0, 20, 21), (drive,), **SHORT)
    state = motion.own[0]
    assert state.own == () and state.command.own.shape == (21, 1)
    assert np.abs(state.command.command).max() > 0.1
    np.testing.assert_allclose(motion.q[-1], 1, atol=1e-2)


@pytest.mark.slow
def test_a_motion_goes_on_from_its_states():
    whole = fj.simulate(WHEEL, STILL, [0, 0.5, 1.0], (LAG,))
    half = fj.State(whole.q[1], whole.qd[1])
    own = jax.tree.map(lambda rows: rows[1], whole.own)
    rest = fj.simulate(WHEEL, half, [0.5, 1.0], (LAG,), own0=own)
    np.testing.assert_allclose(rest.q[-1], whole.q[-1], atol=1e-9)
    with pytest.raises(ValueError, match="own0: expected the states of"):
        fj.simulate(WHEEL, half, [0.5, 1.0], (), own0=own)
    with pytest.raises(ValueError, match="solution.own: expected the states of"):
        fj.joint_efforts(WHEEL, (), whole)


def test_a_state_that_is_not_a_number_is_told():
    own0 = jax.tree.map(lambda x: jnp.nan * x, (LAG.initial_state(WHEEL),))
    solution = fj.simulate(WHEEL, STILL, [0, 1.0], (LAG,), own0=own0, throw=False)
    assert str(solution.outcome) == "not finite"
    assert int(solution.stats["num_steps"]) < 100
    broken = eqx.tree_at(lambda x: x.start, LAG, jnp.full(1, jnp.nan))
    with pytest.raises(ValueError, match=r"forces\[0\]\.start: expected .* finite"):
        fj.simulate(WHEEL, STILL, [0, 1.0], (broken,))


@pytest.mark.slow
def test_states_of_elements_are_swept():
    starts = fj.State(np.linspace(0, 1, 5)[:, None], np.zeros(1))
    solution = fj.sweep(WHEEL, starts, [0, 0.2, 0.4], (LAG,), solver=LoopedDopri8())
    exact = 3 * (1 - np.exp(-np.array([0, 1, 2])))
    effort = solution.own[0].own[..., 0]
    np.testing.assert_allclose(effort, np.tile(exact, (5, 1)), atol=1e-9)
