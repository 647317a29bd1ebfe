"""Sampled control: first order in the period, delay, noise; the discrete step."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT as STEPS
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

# I qdd = tau.
DISC = fj.Linkage(
    "R", length=[0, 0], com=[[0, 0]], mass=[1], inertia=[2.0], gravity=0.0
)
STILL = fj.State(np.zeros(1), np.zeros(1))
RODS = fj.Linkage(
    "RR", length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1] * 2, inertia=[1 / 12] * 2
)
BENT = fj.State(np.array([-0.5, 0.3]), np.array([0.3, -0.2]))
TURN = fj.references.JointMove(BENT.q, [0.5, 0.6], fj.references.Travel(1.0))
CONTROL = fj.PDController([100.0, 50.0], [20.0, 10.0], np.inf, TURN)


def test_sampled_control_converges_at_first_order():
    exact = fj.simulate(RODS, BENT, [0, 0.4], (CONTROL,)).q[-1]
    periods = np.array([4e-3, 2e-3, 1e-3, 5e-4])
    # Equal numbers of samples for all periods, for one program.
    sampled = lambda p: fj.simulate_sampled(RODS, BENT, CONTROL, p, 800).q
    errors = [np.abs(sampled(p)[round(0.4 / p)] - exact).max() for p in periods]
    slopes = np.diff(np.log(errors)) / np.diff(np.log(periods))
    np.testing.assert_allclose(slopes, 1, atol=0.1)


def ramp(t, q, qd, linkage):
    return jnp.stack([1 + t])


@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_efforts_are_held_and_come_late(delay):
    motion = fj.simulate_sampled(DISC, STILL, ramp, 0.1, 5, delay=delay)
    np.testing.assert_allclose(motion.ts, np.arange(6) * 0.1, atol=1e-15)
    commanded = 1 + motion.ts[:-1]
    np.testing.assert_allclose(motion.tau[:, 0], commanded, rtol=1e-12)
    held = np.append(0, commanded)
    gained = ((0.1 - delay) * held[1:] + delay * held[:-1]) / 2
    np.testing.assert_allclose(motion.qd[1:, 0], np.cumsum(gained), rtol=1e-7)
    acting = held[:-1] if delay else held[1:]
    acting = np.append(acting, held[-1])  # at the end the last command acts
    efforts = fj.joint_efforts(DISC, (ramp,), motion).elements[0]
    np.testing.assert_allclose(efforts[:, 0], acting, rtol=1e-12)
    reactions = fj.joint_reactions(DISC, (ramp,), motion)
    np.testing.assert_allclose(reactions[:, 0, 2], acting, rtol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.12])
def test_delays_may_be_traced(delay):
    motion = delayed(delay)
    if delay > 0.1:
        assert np.isnan(motion.q[-1])
        return
    # An inertia of 2 under 1 N m, and under 1.1 N m a period later.
    np.testing.assert_allclose(motion.qd[-1], 0.105 - 0.55 * delay, rtol=1e-7)
    begun = (0.1 - delay) * delay / 2 + delay**2 / 4
    found = motion.q_begin[1] - motion.q[1]
    np.testing.assert_allclose(found, [begun], rtol=1e-6, atol=1e-15)


@jax.jit
def delayed(delay):
    options = dict(delay=delay, solver=LoopedDopri8())
    return fj.simulate_sampled(DISC, STILL, ramp, 0.1, 2, **options)


def test_no_delay_is_known_within_jit():
    """Constant steps cannot end where a late effort starts to act."""
    steps = diffrax.ConstantStepSize()
    options = dict(solver=diffrax.Heun(), stepsize_controller=steps, dt0=0.05)
    end = lambda start: fj.simulate_sampled(DISC, start, ramp, 0.1, 2, **options).qd
    np.testing.assert_allclose(jax.jit(end)(STILL)[-1], 0.105, rtol=1e-7)


def test_noise_is_what_the_key_says():
    seen = lambda t, q, qd, linkage: q + 10 * qd
    run = lambda seed: fj.simulate_sampled(
        RODS, fj.State(np.zeros(2), np.zeros(2)), seen, 1e-6, 400,
        noise=(0.1, [0.02, 0.0]), key=jax.random.key(seed), **STEPS,
    )  # fmt: skip
    first, same, other = run(1), run(1), run(2)
    np.testing.assert_array_equal(first.tau, same.tau)
    assert not np.array_equal(first.tau, other.tau)
    expected = [np.hypot(0.1, 0.2), 0.1]
    np.testing.assert_allclose(np.std(first.tau, axis=0), expected, rtol=0.15)


def test_a_step_is_a_simulation_under_a_held_effort():
    tau, damper = np.array([1.0, -2.0]), fj.JointDamper(0.3)
    after = fj.step(RODS, BENT, tau, 0.1, (damper,))
    motion = fj.simulate(RODS, BENT, [0, 0.1], (damper, fj.JointEffort(tau)))
    np.testing.assert_allclose(after, [motion.q[-1], motion.qd[-1]], rtol=1e-12)


@pytest.mark.slow
def test_a_step_is_differentiable_and_batched():
    """Linearises the step as a predictive controller does."""
    tau = jnp.array([1.0, -2.0])
    step = lambda tau: fj.step(RODS, BENT, tau, 0.1, **STEPS).qd
    known = lambda tau: step(np.asarray(tau))  # by the program of plain calls
    both = jax.jit(jax.vmap(lambda tau: (step(tau), jax.jacrev(step)(tau))), **LOOPS)
    many, (slope, _) = both(jnp.stack([tau, 2 * tau]))
    differences = [(known(tau + h) - known(tau - h)) / 2e-4 for h in 1e-4 * np.eye(2)]
    np.testing.assert_allclose(slope, np.stack(differences, axis=1), atol=1e-8)
    np.testing.assert_allclose(many[0], known(tau), atol=1e-12)


@pytest.mark.slow
def test_gains_of_sampled_control_have_gradients():
    def end(factor):
        control = CONTROL.replace(kp=factor * CONTROL.kp)
        return fj.simulate_sampled(RODS, BENT, control, 0.02, 10, **STEPS).q[-1, 0]

    both = jax.jit(jax.value_and_grad(end), **LOOPS)
    difference = (both(1.001)[0] - both(0.999)[0]) / 0.002
    np.testing.assert_allclose(both(1.0)[1], difference, rtol=1e-6)


@pytest.mark.slow
def test_a_digital_pid_controller_and_motors():
    """The integral takes Euler's steps; motor currents go on between samples."""
    hold = lambda t, linkage: (jnp.ones(1), jnp.zeros(1))
    pid = fj.control.PIDController(8.0, 2.0, 6.0, 50.0, hold)
    motion = fj.simulate_sampled(DISC, STILL, pid, 0.05, 100, **STEPS)
    error, rate = 1 - motion.q[:-1], motion.qd[:-1]
    integral = np.cumsum(0.05 * 2 * error, axis=0) - 0.05 * 2 * error
    np.testing.assert_allclose(motion.tau, 8 * error - 6 * rate + integral, atol=1e-9)
    motor = fj.control.DCMotor(
        fj.JointEffort([12.0]), resistance=2.0, inductance=0.5, constant=0.3
    )
    idle = fj.JointEffort(np.zeros(1))
    sampled = fj.simulate_sampled(DISC, STILL, idle, 0.1, 5, (motor,))
    whole = fj.simulate(DISC, STILL, sampled.ts, (motor,))
    np.testing.assert_allclose(sampled.own[0].own, whole.own[0].own, atol=1e-8)


def test_a_failure_is_named():
    broken = lambda t, q, qd, linkage: jnp.where(t > 0.15, jnp.nan, 0.0) * q
    motion = fj.simulate_sampled(RODS, BENT, broken, 0.1, 4)
    assert motion.result == diffrax.RESULTS.nonfinite
    assert np.isfinite(motion.q[:3]).all() and np.isnan(motion.q[3:]).all()


LAG = fj.control.FirstOrderLag(fj.JointEffort(np.ones(2)), 0.1)
REFUSED = {
    "period: expected": dict(period=0.0),
    "samples: expected": dict(samples=0),
    "delay: expected": dict(delay=0.1),
    "control: expected": dict(control=3.0),
    "forces: expected": dict(forces=[LAG]),
    "noise, key: expected": dict(noise=(0.1, 0.1)),
    "state: expected": dict(state=3.0),
    "dt: expected": dict(dt=0.0),
    "forces: expected elements without": dict(dt=0.1, forces=(LAG,)),
}


@pytest.mark.parametrize("name", REFUSED)
def test_malformed_arguments_are_refused(name):
    values, call = REFUSED[name], fj.simulate_sampled
    right = dict(linkage=RODS, state0=BENT, control=CONTROL, period=0.1, samples=2)
    if "state" in values or "dt" in values:
        call, right = fj.step, dict(linkage=RODS, state=BENT, tau=np.zeros(2), dt=0.1)
    with pytest.raises(ValueError, match=f"^{name}"):
        call(**right | values)
