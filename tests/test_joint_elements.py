"""Springs, stops, friction and histories of efforts: closed forms, derivatives."""

import itertools
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from elements import START, arm
from scipy.optimize import brentq

import fdof_jax as fj
from fdof_jax.forces import EffortHistory, JointFriction, JointStops

# A point mass of 2 kg that slides along y.
SLIDE = fj.Linkage("P", length=[0, 0], com=[[0, 0]], mass=[2], inertia=[1], gravity=0.0)


def slides(start, ts, *forces):
    """Returns positions and velocities of the slide from a start."""
    state0 = fj.State(*np.array(start, float)[:, None])
    motion = fj.simulate(SLIDE, state0, ts, forces)
    return np.asarray(motion.q)[:, 0], np.asarray(motion.qd)[:, 0]


def stored(stops, x):
    return jax.vmap(lambda q: stops.potential_energy(q, SLIDE))(x[:, None])


# Springs


@pytest.mark.parametrize("topology", ["RRR", "PRP"])
def test_mujoco_has_the_same_springs(topology):
    linkage, q = arm(topology), np.array([3.9, -1.2, 0.4])  # beyond half a turn
    springs = fj.forces.JointSpring([30.0, 0.0, 7.0], rest=[-0.5, 0.2, 0.1])
    model = mujoco.MjModel.from_xml_string(fj.to_mjcf(linkage))
    model.jnt_stiffness[:], model.qpos_spring[:] = springs.stiffness, springs.rest
    data = mujoco.MjData(model)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    model.opt.gravity[:] = 0
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    found = springs(0.0, q, np.zeros(3), linkage)
    np.testing.assert_allclose(found, data.qfrc_passive, rtol=1e-12)
    energy = springs.potential_energy(q, linkage)
    np.testing.assert_allclose(energy, data.energy[0], rtol=1e-12)


@pytest.mark.slow
def test_a_mass_swings_on_a_spring():
    """One number serves all joints, and the period is 2 pi sqrt(m / k)."""
    ts = np.pi * np.sqrt(2 / 8) * np.arange(4)  # half periods
    x, v = slides([1.5, 0.0], ts, fj.forces.JointSpring(8.0, 0.5))
    np.testing.assert_allclose(x, [1.5, -0.5, 1.5, -0.5], atol=1e-8)
    np.testing.assert_allclose(v, 0, atol=1e-7)


# Stops


@pytest.mark.slow
def test_a_bounce_keeps_the_energy():
    """The penetration is (d + w)^2 / 4w up to a depth w, and the depth beyond."""
    k, w, end = 300.0, 0.02, 1.0
    stops = JointStops(-np.inf, end, stiffness=k, smoothing=w)
    x, v = slides([0.5, 3.0], np.linspace(0, 1, 101), stops)
    d = x - end
    potential = k * np.where(
        d < -w, 0, np.where(d < w, (d + w) ** 3 / (12 * w), d**2 / 2 + w**2 / 6)
    )
    assert (np.abs(d) < w).any() and (d > w).any()
    np.testing.assert_allclose(stored(stops, x), potential, atol=1e-12)
    energy = v**2 + potential  # of 2 kg
    assert d.max() > 0.1 and v[-1] < -2.9
    # Between steps positions are interpolated.
    np.testing.assert_allclose(energy, energy[0], rtol=3e-8)
    np.testing.assert_allclose(energy[-1], energy[0], rtol=1e-9)


@pytest.mark.slow
def test_deep_in_a_stop_the_spring_is_linear():
    """A contact lasts half a period of sqrt(k/m)."""
    k, speed = 800.0, 2.0
    stops = JointStops(-1.0, np.inf, stiffness=k)
    half, depth = np.pi / np.sqrt(k / 2), speed / np.sqrt(k / 2)
    x, v = slides([-1.0, -speed], [0, half / 2, half], stops)
    np.testing.assert_allclose(x, [-1, -1 - depth, -1], atol=1e-8)
    np.testing.assert_allclose(v, [-speed, 0, speed], atol=1e-7)
    np.testing.assert_allclose(stored(stops, x), [0, speed**2, 0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "mass, stiffness, damping, speed",
    [(0.1, 1e6, 0.6, 2.0), (0.01, 1e7, 0.5, 5.0), (2.0, 3e2, 0.3, 3.0)],
)
def test_a_rebound_loses_what_the_law_says(mass, stiffness, damping, speed):
    """v dv / (1 + d v) = -k/m p dp: its integral is equal before and after a blow."""
    back, slope = rebound(speed, mass, stiffness, damping)
    expected = rebound_by_law(speed, damping)
    np.testing.assert_allclose(back, expected, rtol=1e-8)
    change = lambda v: v / (1 + damping * v)  # of the integral
    np.testing.assert_allclose(slope, change(speed) / -change(-expected), rtol=1e-5)


def rebound_by_law(speed, damping):
    integral = lambda v: v / damping - np.log1p(damping * v) / damping**2
    lost = lambda back: integral(-back) - integral(speed)
    return brentq(lost, 1e-9, min(speed, (1 - 1e-12) / damping), xtol=1e-14)


@jax.jit
@jax.value_and_grad
def rebound(speed, mass, stiffness, damping):
    slide = eqx.tree_at(lambda arm: arm.mass, SLIDE, mass[None])
    start = fj.State(jnp.array([0.9]), speed[None])
    stops = JointStops(-np.inf, 1.0, stiffness=stiffness, damping=damping)
    return -fj.simulate(slide, start, [0, 1.0], (stops,)).qd[-1, 0]


@jax.jit  # one program for all numbers
@partial(jax.vmap, in_axes=(None, 0, 0, 0, 0))
def rebounds(share, mass, stiffness, damping, speed):
    """Returns speeds after blows; `share` is that of an elastic blow's depth."""
    depth = speed * jnp.sqrt(mass / stiffness)
    smoothing = None if share is None else share * depth
    stops = JointStops(
        -np.inf, 1.0, stiffness=stiffness, damping=damping, smoothing=smoothing
    )
    near = 2 * (depth if share is None else depth + smoothing)
    slide = eqx.tree_at(lambda arm: arm.mass, SLIDE, mass[None])
    start = fj.State((1 - near)[None], speed[None])
    end = 200 * near / speed * (1 + damping * speed)
    motion = fj.simulate(slide, start, jnp.stack([0 * end, end]), (stops,))
    return -motion.qd[-1, 0]


@pytest.mark.slow
@pytest.mark.parametrize("share", [None, 0.03, 1.0, 100.0])
def test_smoothing_takes_nothing_from_damping(share):
    values = [0.01, 100.0], [1e2, 1e7], [0.01, 2.0], [0.1, 10.0]
    blows = np.array([*itertools.product(*values)])
    expected = [rebound_by_law(speed, damping) for _, _, damping, speed in blows]
    np.testing.assert_allclose(rebounds(share, *blows.T), expected, rtol=1e-8)


def test_damped_stops_push_by_their_law_and_never_pull():
    options = dict(stiffness=300.0, damping=0.3)
    ends = JointStops([-np.inf, -1.0], [1.0, np.inf], **options)
    rounded = ends.replace(smoothing=0.1)
    push = 300 * 0.12**2 / 0.4 * (1 + 0.3 * 3.0)
    for stops, depth, rate, expected in (
        (ends, 0.1, -50.0, 0),
        (ends, 0.02, 3.0, 300 * 0.02 * (1 + 0.3 * 3.0)),
        (rounded, 0.02, 3.0, push),
    ):
        out = np.array([1.0, -1.0])  # the lower stop is the upper one's image
        found = stops(0.0, (1 + depth) * out, rate * out, None)
        np.testing.assert_allclose(found, -expected * out, rtol=1e-12)


def test_within_the_range_stops_do_nothing_and_outside_they_push_back():
    stops = JointStops([-1, -np.inf, -2], [1, 2, np.inf])
    for q, expected in (
        ([0.5, -1e30, 1e30], [0, 0, 0]),
        ([-1.5, 3.0, -2.5], [5e3, -1e4, 5e3]),
    ):
        found = stops(0.0, np.array(q), np.zeros(3), None)
        np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("smoothing", [None, 1e-3])
def test_stops_have_finite_derivatives_everywhere(smoothing):
    push = jax.jit(lambda q, qd, stops: stops(0.0, q, qd, None))
    reverse, forward = jax.jit(jax.jacrev(push, (0, 1))), jax.jit(jax.jacfwd(push))
    ends = -1.0, [1.0, np.inf, 1e300]
    stops = JointStops(*ends, damping=0.5, smoothing=smoothing)
    for x in (-1e30, -1.0, 0.0, 1.0, 1e12):
        slopes = reverse(np.full(3, x), np.ones(3), stops)
        assert all(np.isfinite(s).all() for s in slopes)
    finite = eqx.tree_at(lambda s: s.upper, stops, jnp.ones(3))
    for k in range(5):
        if smoothing is None and k == 2:
            continue  # at the end itself the slope jumps
        q, h, ones = np.full(3, 0.9995 + 2.5e-4 * k), 1e-7, np.ones(3)
        slope = forward(q, ones, finite)
        ends = [np.asarray(push(q + s, ones, finite)) for s in (h, -h)]
        difference = (ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(np.diag(slope), difference, rtol=1e-5, atol=1e-3)


# Friction


@pytest.mark.slow
def test_friction_stops_a_slide():
    """From 2 dv/dt = -F tanh(v/s) it follows that sinh(v/s) falls exponentially."""
    level, speed, v0 = 4.0, 0.05, 1.5
    ts = np.linspace(0, 1.2, 25)
    friction = JointFriction(level, speed=speed)
    motion = fj.simulate(SLIDE, fj.State([0.0], [v0]), ts, (friction,))
    exact = speed * np.arcsinh(np.sinh(v0 / speed) * np.exp(-level / 2 * ts / speed))
    np.testing.assert_allclose(motion.qd[:, 0], exact, rtol=1e-7, atol=1e-10)
    assert motion.modes is motion.taken is motion.events is None  # it holds nothing


# Histories

TS = np.array([0.1, 0.25, 0.3, 0.62])
TAU = np.random.default_rng(0).normal(size=(4, 3))


def test_efforts_are_linear_between_the_times_and_held_beyond():
    history, zero = EffortHistory(TS, TAU), np.zeros(3)
    times = np.array([-1, 0.1, 0.17, 0.25, 0.299, 0.5, 0.62, 3])
    found = jax.vmap(lambda t: history(t, zero, zero, None))(times)
    expected = np.stack([np.interp(times, TS, column) for column in TAU.T], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_array_equal(history.jump_ts, TS)
    constant = EffortHistory([0.5], TAU[:1])
    np.testing.assert_array_equal(constant(0.7, zero, zero, None), TAU[0])


@pytest.mark.slow
def test_the_momentum_gained_is_the_integral_of_the_efforts():
    """The slide on the ground has a momentum that only efforts change."""
    linkage = eqx.tree_at(lambda k: k.gravity, arm("PRR"), 0.0)
    momentum = lambda q, qd: fj.inverse_dynamics(linkage, q, 0 * q, qd)[0]
    # Trapezia, and the constant efforts before and after.
    weights = np.array([0.1 + 0.075, 0.1, 0.025 + 0.16, 0.16 + 0.08])
    expected = momentum(*START) + weights @ TAU[:, 0]
    fixed = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.01)
    for steps in ({}, fixed):  # those end at the times too, and round
        forces = (EffortHistory(TS, TAU),)
        solution = fj.simulate(linkage, START, [0, 0.7], forces, **steps)
        end = momentum(solution.q[-1], solution.qd[-1])
        np.testing.assert_allclose(end, expected, atol=1e-8)


def test_one_effort_for_all_joints():
    zero, arm = np.zeros(3), fj.scenes.fig5().linkage
    found = fj.JointEffort(1.5)(0.0, zero, zero, arm)
    np.testing.assert_array_equal(found, [1.5] * 3)
