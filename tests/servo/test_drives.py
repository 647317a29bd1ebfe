"""Servo drives: closed forms, limits, and the states that they integrate."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Hold
from scipy.linalg import expm

import fdof_jax as fj

# A balanced wheel: 2 qdd = tau.
WHEEL = fj.Linkage(
    "R", length=[0, 0], com=[[0, 0]], mass=[1], inertia=[2.0], gravity=0.0
)
STILL = fj.State(np.zeros(1), np.zeros(1))
LAG = fj.control.FirstOrderLag(fj.JointEffort([3.0]), 0.2)


def motor(volts, **options):
    command = fj.JointEffort([volts])
    return fj.control.DCMotor(command, resistance=2.0, constant=0.1, **options)


def test_a_lag_is_an_exponential():
    """It is told if it is not a number."""
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
    with pytest.raises(ValueError, match="solution.own: expected the states of"):
        fj.joint_efforts(WHEEL, (), solution)
    own0 = jax.tree.map(lambda x: jnp.nan * x, (LAG.initial_state(WHEEL),))
    lost = fj.simulate(WHEEL, STILL, ts, (LAG,), own0=own0, throw=False)
    assert lost.outcome == "not finite" and lost.stats["num_steps"] < 100


def test_a_condition_ends_a_motion_under_sampled_control():
    """Between samples: q = t^2."""
    ends = dict(until=lambda t, q, qd, linkage: q[0] - 0.04, rtol=1e-9, atol=1e-12)
    pushed = WHEEL, STILL, fj.JointEffort([4.0]), 0.07, 4
    motion = fj.simulate_sampled(*pushed, solver=diffrax.Tsit5(), **ends)
    assert motion.ended and motion.tau.shape == (4, 1)
    np.testing.assert_allclose([motion.end.t, *motion.end.qd], [0.2, 0.4], rtol=1e-9)
    np.testing.assert_allclose(motion.q[:, 0], [0, 0.07**2, 0.14**2, np.nan, np.nan])


@pytest.mark.slow
def test_a_motor_reaches_its_current_and_its_speed():
    # L di/dt = v - R i - k n w, J dw/dt = k n i.
    rates, ts = np.array([[-2 / 0.5, -0.3 / 0.5], [0.3 / 2, 0]]), np.linspace(0, 5, 21)
    steady = np.linalg.solve(rates, [-12 / 0.5, 0])
    exact = np.array([steady - expm(rates * t) @ steady for t in ts])
    motion = fj.simulate(WHEEL, STILL, ts, (motor(12.0, inductance=0.5, gear=3.0),))
    found = np.hstack([motion.own[0].own, motion.qd])
    np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-6)


# Commands and speeds in all pairs, to 1.5 times the speed without load at 40 V, of a
# resistance of 2 ohm, and 0.3 N m/A at the joint.
STATIC, TOP = motor(12.0, gear=3.0), 40 / 0.3
GRID = np.meshgrid([-1e3, -30.0, -2, 0, 5, 60], TOP * np.linspace(-1.5, 1.5, 13))
COMMANDS, SPEEDS = (rows.ravel() for rows in GRID)


@pytest.mark.parametrize("volts, amps", [(np.inf, np.inf), (40, 3.0), (40, np.inf)])
def test_without_inductance_currents_are_those_at_which_others_would_end(volts, amps):
    drive = STATIC.replace(voltage_limit=volts, current_limit=amps)
    effort, rate = drive.respond(COMMANDS, SPEEDS, ())
    current, back_emf = np.asarray(effort) / 0.3, 0.3 * SPEEDS
    assert rate == ()
    exact = np.clip((COMMANDS - back_emf) / 2, -amps, amps)
    least, most = ((sign * volts - back_emf) / 2 for sign in (-1, 1))
    np.testing.assert_allclose(current, np.clip(exact, least, most), atol=1e-12)
    same, rate = drive.replace(inductance=0.5).respond(COMMANDS, SPEEDS, current)
    np.testing.assert_allclose(same, effort, rtol=1e-12)
    np.testing.assert_allclose(rate, 0, atol=1e-11)


def test_an_inductance_is_of_all_joints_or_of_none():
    for zero in (0, [0.0, 0.0], None):
        assert STATIC.replace(inductance=zero).inductance is None
    currents = lambda value: STATIC.replace(inductance=value).initial(WHEEL)
    for value, count in ((np.array([0.1]), 1), (jnp.zeros(1), 0)):
        within = jax.jit(lambda value=value: currents(value))
        assert np.size(currents(value)) == np.size(within()) == count
    within = jax.vmap(lambda value: STATIC.replace(inductance=value))(np.zeros(2))
    assert not within.possible()  # while it is traced, it is taken for positive


def test_a_speed_limit_in_four_quadrants():
    """Driving, it falls with the speed; braking, the whole effort is left."""
    drive = fj.control.SpeedLimit(fj.JointEffort([1.0]), 6.0, TOP)
    effort, _ = drive.respond(COMMANDS, SPEEDS, ())
    driving = COMMANDS * SPEEDS > 0
    most = 6 * np.where(driving, np.maximum(1 - np.abs(SPEEDS) / TOP, 0), 1)
    exact = np.sign(COMMANDS) * np.minimum(np.abs(COMMANDS), most)
    np.testing.assert_allclose(effort, exact, atol=1e-12)


@pytest.mark.parametrize("ki, limit", [(0.0, 0.5), (3.0, 0.5), (3.0, np.inf)])
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
