"""Sampled control: held efforts, delays and noise; the discrete step; pictures."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR, FORWARD, SHORT as STEPS
from figures import tidy as tidy, values
from modes import ADJOINT, LOOPS, jacobian

import fdof_jax as fj
from fdof_jax import plotting
from fdof_jax.simulation.sampled_control import _in_periods

# I qdd = tau.
DISC = BAR.replace(com=[[0, 0]], inertia=[2.0], gravity=0.0)
STILL = fj.State(np.zeros(1), np.zeros(1))
RODS = fj.Linkage(
    "RR", length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1] * 2, inertia=[1 / 12] * 2
)
BENT = fj.State(np.array([-0.5, 0.3]), np.array([0.3, -0.2]))
TURN = fj.references.JointMove(BENT.q, [0.5, 0.6], fj.references.Travel(1.0))
CONTROL = fj.PDController([100.0, 50.0], [20.0, 10.0], np.inf, TURN)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.17, 0.3])  # 0.3 / 0.1 is 2.9999999999999996
def test_efforts_are_held_and_come_late(delay):
    ramp = lambda t, q, qd, linkage: jnp.stack([1 + t])
    motion = fj.simulate_sampled(DISC, STILL, ramp, 0.1, 5, delay=delay)
    np.testing.assert_allclose(motion.ts, np.arange(6) * 0.1, atol=1e-15)
    commanded = 1 + motion.ts[:-1]
    np.testing.assert_allclose(motion.tau[:, 0], commanded, rtol=1e-12)
    whole, part = divmod(round(100 * delay), 10)
    late = np.concatenate([np.zeros(whole + 1), commanded, commanded[-1:]])
    before, after = late[:5], late[1:6]  # what acts first and last in each period
    gains = np.cumsum((10 - part) * after + part * before) / 200
    np.testing.assert_allclose(motion.qd[1:, 0], gains, rtol=1e-7, atol=1e-15)
    acting = late[:6] if part else late[1:7]  # at the end the last command acts
    efforts = fj.joint_efforts(DISC, (ramp,), motion).elements[0]
    np.testing.assert_allclose(efforts[:, 0], acting, rtol=1e-12)
    reactions = fj.joint_reactions(DISC, (ramp,), motion)
    np.testing.assert_allclose(reactions[:, 0, 2], acting, rtol=1e-12)


def advance(x, delay, gains):
    """Advances a disc under delayed feedback by a period of 0.1 s, in closed form.

    The state `x` is its position, velocity, and commands under way, the newest first.
    Returns it with the effort at the start.
    """
    whole = int(delay / 0.1 + 1e-9)
    commands = [-gains @ x[:2], *x[2:]]
    part, (new, last) = delay - 0.1 * whole, commands[whole : whole + 2]
    if part < 1e-9:
        last = new
    q, qd = x[0] + part * x[1] + part**2 * last / 4, x[1] + part * last / 2
    rest = 0.1 - part
    q, qd = q + rest * qd + rest**2 * new / 4, qd + rest * new / 2
    after = np.array([q, qd, *commands[: whole + 1]])
    return after, last


def sampled(delay, gains):
    """Returns rows of 60 samples, and the last position.

    Rows are position, velocity, effort and command.
    """
    x, rows = np.array([1, *np.zeros(2 + int(delay / 0.1 + 1e-9))]), []
    for _ in range(60):
        after, effort = advance(x, delay, gains)
        rows.append([*x[:2], effort, after[2]])
        x = after
    return np.array(rows), x[0]


class Idle(fj.Element):
    """No effort, at which steps end all the same."""

    jump_ts: fj.Values = fj.field((), unit="s")

    def __call__(self, t, q, qd, linkage):
        return jnp.zeros_like(q)


def delayed(delay, gains):
    """Beside another element with a known time, whose clock is another."""
    feedback = lambda t, q, qd, linkage: -gains[0] * q - gains[1] * qd
    start, idle = fj.State(jnp.ones(1), jnp.zeros(1)), (Idle(0.35),)
    options = dict(delay=delay, throw=False)
    motion = fj.simulate_sampled(DISC, start, feedback, 0.1, 60, idle, **options)
    return motion.q[-1, 0], motion


@pytest.mark.slow
def test_delayed_feedback_follows_its_transition_matrix():
    """For traced delays and gains, with derivatives."""
    delays = 0.1 * np.array([0, 0.3, 1, 1.5, 2, 3.7, 1e6, -0.1])
    gains = np.array([[8.0, 6.0], [30.0, 12.0]])
    both = jax.value_and_grad(delayed, (0, 1), has_aux=True)
    pairs = jax.vmap(jax.vmap(both, (None, 0)), (0, None))
    (_, motions), slopes = jax.jit(pairs, **LOOPS)(delays, gains)
    for i, j in np.ndindex(6, 2):
        delay, gain = delays[i], gains[j]
        one = lambda leaf, i=i, j=j: leaf[i, j]
        motion, of_delay, of_gains = jax.tree.map(one, (motions, *slopes))
        rows, _ = sampled(delay, gain)
        found = motion.q[:-1], motion.qd[:-1], motion.acting[:-1], motion.tau
        size, found = np.abs(rows).max(), np.concatenate(found, axis=1)
        np.testing.assert_allclose(found, rows, atol=1e-9 * size, rtol=0)
        # To one side, as there is a kink where a delay is a whole number of periods.
        end = lambda delay, gain: sampled(delay, gain)[1]
        ends = [end(delay + h, gain) for h in (0, 1e-5, 2e-5)]
        difference = np.array([-3, 4, -1]) @ ends / 2e-5
        np.testing.assert_allclose(of_delay, difference, rtol=1e-5, atol=1e-9 * size)
        steps = 1e-4 * np.eye(2)
        change = [(end(delay, gain + h) - end(delay, gain - h)) / 2e-4 for h in steps]
        np.testing.assert_allclose(of_gains, change, rtol=1e-5, atol=1e-9 * size)
    np.testing.assert_array_equal(motions.q[6], 1)  # no command arrives
    np.testing.assert_array_equal(motions.acting[6], 0)
    assert np.isnan(motions.q[7, :, -1]).all()  # a delay below 0


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_a_delay_of_whole_periods_is_known_in_either_precision(precision):
    """0.3 / 0.1 is less than 3 by a rounding error of the precision."""
    with jax.enable_x64(precision == np.float64):
        late = _in_periods(0.3, jnp.asarray(0.1), 5)
        rest = _in_periods(0.17, jnp.asarray(0.1), 5).rest
    assert (late.whole, late.rest, late.most) == (3, None, 3)
    assert rest.dtype == precision


@pytest.mark.slow
def test_constant_steps_have_derivatives_in_period_and_delay_by_the_adjoint():
    """The disc's effort of 1 N m begins to act after the delay."""

    steps = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.011)

    def turned(times):
        period, delay = times
        scene = DISC, STILL, lambda t, q, qd, linkage: jnp.ones(1), period, 3
        options = dict(delay=delay, adjoint=ADJOINT) | steps
        return fj.simulate_sampled(*scene, **options).q[-1, 0]

    q, slopes = jax.jit(jax.value_and_grad(turned), **LOOPS)(jnp.array([0.1, 0.03]))
    time = 3 * 0.1 - 0.03
    np.testing.assert_allclose(q, time**2 / 4, rtol=1e-9)
    np.testing.assert_allclose(slopes, [3 * time / 2, -time / 2], rtol=1e-9)


@pytest.mark.slow
def test_a_sample_sees_what_a_blow_leaves():
    """A load is caught at a sample, with derivatives in the gain."""
    load = fj.forces.Payload(fj.Point(1, along=0), 1.0, 2.0, begin=0.25)  # I doubles

    def commands(gain):
        brakes = lambda t, q, qd, linkage: -gain * qd
        scene = DISC, fj.State([1.0], [0.2]), brakes, 0.125, 4, (load,)
        return fj.simulate_sampled(*scene, **FORWARD).tau[:, 0]

    both = jax.jit(lambda x: jax.jvp(commands, (x,), (1.0,)), **LOOPS)
    expected = [-0.4, -0.35, -0.153125, -0.1435546875]
    np.testing.assert_allclose(both(2.0)[0], expected, rtol=1e-9)
    difference = (both(2 + 1e-5)[0] - both(2 - 1e-5)[0]) / 2e-5
    np.testing.assert_allclose(both(2.0)[1], difference, rtol=1e-7)


@pytest.mark.slow
def test_no_time_is_left_out_at_samples():
    """Far from the time 0, where 32 units of rounding are 7e-6 of a period."""
    idle = lambda t, q, qd, linkage: jnp.zeros(1)
    start, t0 = fj.State([0.0], [1.0]), 1e9
    motion = fj.simulate_sampled(DISC, start, idle, 0.02, 500, t0=t0, delay=0.005)
    np.testing.assert_allclose(motion.q[-1], motion.ts[-1] - t0, rtol=1e-9)


def test_a_fixed_pair_behind_the_disc_changes_nothing():
    fixed = dict(length=[0, 0, 0], com=[[0, 0]] * 2, mass=[1, 0], inertia=[2.0, 0])
    arm, still = fj.Linkage("RF", gravity=0.0, **fixed), fj.State([0, 0], [0, 0])
    ramp = lambda t, q, qd, linkage: (1 + t) * jnp.ones(2)
    motion = fj.simulate_sampled(arm, still, ramp, 0.1, 5, **STEPS)
    assert not motion.tau[:, 1].any()
    gains = np.cumsum(0.1 * np.array([0, 1, 1.1, 1.2, 1.3, 1.4]) / 2)
    np.testing.assert_allclose(motion.qd, np.outer(gains, [1, 0]), atol=1e-14)
    q = np.append(0, np.cumsum((gains[1:] + gains[:-1]) * 0.1 / 2))
    np.testing.assert_allclose(motion.q, np.outer(q, [1, 0]), atol=1e-14)


@pytest.mark.slow
def test_a_digital_pid_controller_takes_euler_steps():
    hold = lambda t, linkage: (jnp.ones(1), jnp.zeros(1))
    pid = fj.control.PIDController(8.0, 2.0, 6.0, 50.0, hold)
    motion = fj.simulate_sampled(DISC, STILL, pid, 0.05, 100, **STEPS)
    error, rate = 1 - motion.q[:-1], motion.qd[:-1]
    integral = np.cumsum(0.05 * 2 * error, axis=0) - 0.05 * 2 * error
    np.testing.assert_allclose(motion.tau, 8 * error - 6 * rate + integral, atol=1e-9)


@pytest.mark.slow
def test_noise_is_what_the_key_says():
    seen = lambda t, q, qd, linkage: q + 10 * qd
    scene = RODS, fj.State(np.zeros(2), np.zeros(2)), seen, 1e-6, 400
    options = dict(noise=(0.1, [0.02, 0.0])) | STEPS
    first, same, other = (
        fj.simulate_sampled(*scene, key=jax.random.key(seed), **options)
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.tau, same.tau)
    assert not np.array_equal(first.tau, other.tau)
    expected = [np.hypot(0.1, 0.2), 0.1]
    np.testing.assert_allclose(np.std(first.tau, axis=0), expected, rtol=0.15)


@pytest.mark.slow
def test_a_step_is_a_simulation_under_a_held_effort():
    """Linearised as a predictive controller does, in a batch."""
    tau, h, damper = np.array([1.0, -2.0]), 1e-4 * np.eye(2), fj.JointDamper(0.3)
    step = lambda tau: fj.step(RODS, BENT, tau, 0.1, (damper,), **STEPS)
    both = jax.jit(jax.vmap(lambda tau: (step(tau), jax.jacrev(step)(tau))), **LOOPS)
    (q, qd), slopes = both(jnp.stack([tau, *(tau + h), *(tau - h)]))
    forces = damper, fj.JointEffort(tau)
    motion = fj.simulate(RODS, BENT, [0, 0.1], forces, **STEPS)
    found = q[0], qd[0]
    np.testing.assert_allclose(found, [motion.q[-1], motion.qd[-1]], rtol=1e-12)
    for rows, slope in zip((q, qd), slopes):
        differences = (rows[1:3] - rows[3:5]) / 2e-4
        np.testing.assert_allclose(slope[0], differences.T, atol=1e-8)


@pytest.mark.slow
def test_joints_are_held_between_samples():
    """Stops, friction, samples and arrivals in one motion, with all derivatives."""
    limits = fj.forces.HardStops([-0.6, 0.28], [-0.42, 0.5], restitution=0.5)

    def end(parts):
        q0, gain, level, period, delay = parts
        start = fj.State(BENT.q + q0 * np.array([1, 0]), BENT.qd)
        forces = fj.forces.JointFriction(level, level + 0.3), limits
        control = CONTROL.replace(kp=gain * CONTROL.kp)
        scene = RODS, start, control, period, 24, forces
        motion = fj.simulate_sampled(*scene, delay=delay, **FORWARD)
        last = motion.q[-1], motion.qd[-1], motion.tau[20]
        return jnp.concatenate([*last, motion.taken[-1:], motion.events.t[:2]])

    of, parts = jacobian(end), jnp.array([0.0, 1.0, 0.5, 0.02, 0.007])
    steps = np.array([1e-6, 1e-6, 1e-6, 1e-7, 1e-7])
    changes = [of(parts + h)[1] - of(parts - h)[1] for h in np.diag(steps)]
    slopes, _ = of(parts)
    errors = np.abs(slopes - np.transpose(changes) / (2 * steps)).max(axis=0)
    assert (errors < 1e-6 * np.abs(slopes).max(axis=0)).all()


def test_held_efforts_are_known_with_their_work():
    """Of the exact motion of a disc from rest."""
    tau = np.array([[4.0], [-8.0], [2.0], [6.0]])
    ts, acting = np.linspace(0, 2, 5), np.append(tau, tau[-1:], axis=0)
    qd = np.append([[0.0]], np.cumsum(tau / 4, axis=0), axis=0)
    q = np.append([[0.0]], np.cumsum((qd[1:] + qd[:-1]) / 4, axis=0), axis=0)
    rows, result = (ts, q, qd), diffrax.RESULTS.successful
    motion = fj.Solution(*rows, {}, result, tau=tau, acting=acting)
    pd = fj.PDController(0.0, 0.0, 8.0, lambda t, linkage: (t[None], t[None]))
    total, (held, damped) = fj.joint_efforts(DISC, (pd, fj.JointDamper(0.5)), motion)
    np.testing.assert_array_equal(held, acting)
    np.testing.assert_array_equal(total, held + damped)
    with pytest.raises(ValueError, match=r"forces: expected \(control, \*forces\)"):
        fj.joint_efforts(DISC, (), motion)
    # The spring pulls as it did at a sample, and stores nothing.
    spring = fj.SpringDamper(fj.Point(0, 1), fj.Point(1, 0, 1), stiffness=9.0)
    for control in pd, spring:
        ax = plotting.energy_stack(DISC, (control,), motion)
        np.testing.assert_allclose(values(ax)[0][-1], 1.75)  # [J] put in
