"""Stops and friction: closed forms, energy, power, finite derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_linkage
from scipy.optimize import brentq

import fdof_jax as fj

# The last joint slides a point mass of 2 kg along x; nothing else moves much.
with pytest.warns(UserWarning, match="joints 1 and 2 coincide"):
    SLIDE = fj.Linkage(
        "RRP", length=[0, 0, 0, 0], com=[[0, 0]] * 3, mass=[1, 1, 2],
        inertia=[1, 1, 1], gravity=0.0,
    )  # fmt: skip
STILL = np.zeros(3)


def last(value):
    return np.array([0.0, 0.0, value])


def test_a_bounce_keeps_the_energy():
    """The penetration is (d + w)^2 / 4w up to a depth w, and the depth beyond."""
    k, w, end = 300.0, 0.02, 1.0
    stops = fj.forces.JointStops(
        -np.inf, [np.inf, np.inf, end], stiffness=k, smoothing=w
    )
    ts = np.linspace(0, 1, 101)
    solution = fj.simulate(SLIDE, fj.State(last(0.5), last(3.0)), ts, (stops,))
    x, v = np.asarray(solution.q[:, 2]), np.asarray(solution.qd[:, 2])
    d = x - end
    potential = k * np.where(
        d < -w, 0, np.where(d < w, (d + w) ** 3 / (12 * w), d**2 / 2 + w**2 / 6)
    )
    assert (np.abs(d) < w).any() and (d > w).any()
    own = jax.vmap(lambda q: stops.potential_energy(q, SLIDE))(solution.q)
    np.testing.assert_allclose(own, potential, atol=1e-12)
    energy = v**2 + potential  # of 2 kg
    assert d.max() > 0.1 and v[-1] < -2.9
    # Between steps positions are interpolated.
    np.testing.assert_allclose(energy, energy[0], rtol=3e-8)
    np.testing.assert_allclose(energy[-1], energy[0], rtol=1e-9)


def test_deep_in_a_stop_the_spring_is_linear():
    """A contact lasts half a period of sqrt(k/m)."""
    k, speed = 800.0, 2.0
    stops = fj.forces.JointStops(-1.0, np.inf, stiffness=k)
    half = np.pi / np.sqrt(k / 2)
    motion = fj.simulate(
        SLIDE, fj.State(last(-1.0), last(-speed)), [0, half / 2, half], (stops,)
    )
    depth = speed / np.sqrt(k / 2)
    np.testing.assert_allclose(motion.q[:, 2], [-1, -1 - depth, -1], atol=1e-8)
    np.testing.assert_allclose(motion.qd[:, 2], [-speed, 0, speed], atol=1e-7)
    stored = jax.vmap(lambda q: stops.potential_energy(q, SLIDE))(motion.q)
    np.testing.assert_allclose(stored, [0, speed**2, 0], atol=1e-6)  # of 2 kg


@pytest.mark.parametrize(
    "mass, stiffness, damping, speed",
    [(0.1, 1e6, 0.6, 2.0), (0.01, 1e7, 0.5, 5.0), (2.0, 3e2, 0.3, 3.0)],
)
def test_a_rebound_loses_what_the_law_says(mass, stiffness, damping, speed):
    """v dv / (1 + d v) = -k/m p dp: its integral is equal before and after a blow."""
    back, slope = rebound(speed, mass, stiffness, damping)
    integral = lambda v: v / damping - np.log1p(damping * v) / damping**2
    lost = lambda back: integral(-back) - integral(speed)
    expected = brentq(lost, 1e-9, min(speed, (1 - 1e-12) / damping), xtol=1e-14)
    np.testing.assert_allclose(back, expected, rtol=1e-8)
    change = lambda v: v / (1 + damping * v)  # of the integral
    np.testing.assert_allclose(slope, change(speed) / -change(-expected), rtol=1e-5)


@jax.jit
@jax.value_and_grad
def rebound(speed, mass, stiffness, damping):
    arm = fj.Linkage(
        "P",
        length=[0, 0],
        com=[[0, 0]],
        mass=jnp.stack([mass]),
        inertia=[1],
        gravity=0.0,
    )
    start = fj.State(jnp.array([0.9]), jnp.stack([speed]))
    ends = -np.inf, 1.0
    stops = fj.forces.JointStops(*ends, stiffness=stiffness, damping=damping)
    return -fj.simulate(arm, start, [0, 1.0], (stops,)).qd[-1, 0]


def test_damping_takes_energy_and_never_pulls():
    stops = fj.forces.JointStops(-np.inf, 1.0, stiffness=300.0, damping=0.3)
    start = fj.State(last(0.9), last(3.0))
    solution = fj.simulate(SLIDE, start, np.linspace(0, 1, 201), (stops,))
    assert 0.3 < -solution.qd[-1, 2] / 3 < 0.9
    efforts = fj.joint_efforts(SLIDE, (stops,), solution).total[:, 2]
    assert efforts.min() < -50 and efforts.max() <= 0
    fast = stops(0.0, last(1.1), last(-50.0), SLIDE)
    assert fast[2] == 0
    # Where the penetration is rounded off, damping acts by its rate.
    smooth = fj.forces.JointStops(
        -np.inf, 1.0, stiffness=300.0, damping=0.3, smoothing=0.1
    )
    penetration, rate = 0.12**2 / 0.4, 0.12 / 0.2 * 3.0
    expected = -300 * penetration * (1 + 0.3 * rate)
    found = smooth(0.0, last(1.02), last(3.0), SLIDE)
    np.testing.assert_allclose(found[2], expected, rtol=1e-12)
    # The lower stop is the upper one's image.
    other = fj.forces.JointStops(
        -1.0, np.inf, stiffness=300.0, damping=0.3, smoothing=0.1
    )
    found = other(0.0, last(-1.02), last(-3.0), SLIDE)
    np.testing.assert_allclose(found[2], -expected, rtol=1e-12)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_within_the_range_stops_do_nothing_and_outside_they_push_back(topology):
    linkage = random_linkage(topology, np.random.default_rng(0))
    stops = fj.forces.JointStops([-1, -np.inf, -2], [1, 2, np.inf])
    inside = stops(0.0, np.array([0.5, -1e30, 1e30]), STILL, linkage)
    np.testing.assert_array_equal(inside, 0)
    outside = stops(0.0, np.array([-1.5, 3.0, -2.5]), STILL, linkage)
    np.testing.assert_allclose(outside, [5e3, -1e4, 5e3], rtol=1e-9)


@pytest.mark.parametrize("smoothing", [None, 1e-3])
def test_stops_have_finite_derivatives_everywhere(smoothing):
    @jax.jit
    def push(q, qd, stops):
        return stops(0.0, q, qd, SLIDE)

    reverse, forward = jax.jit(jax.jacrev(push, (0, 1))), jax.jit(jax.jacfwd(push))
    stops = fj.forces.JointStops(
        -1.0, [1.0, np.inf, 1e300], damping=0.5, smoothing=smoothing
    )
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


def test_friction_stops_a_slide():
    """From 2 dv/dt = -F tanh(v/s) it follows that sinh(v/s) falls exponentially."""
    level, speed, v0 = 4.0, 0.05, 1.5
    friction = fj.forces.JointFriction(level, speed)
    ts = np.linspace(0, 1.2, 25)
    solution = fj.simulate(SLIDE, fj.State(STILL, last(v0)), ts, (friction,))
    exact = speed * np.arcsinh(np.sinh(v0 / speed) * np.exp(-level / 2 * ts / speed))
    np.testing.assert_allclose(solution.qd[:, 2], exact, rtol=1e-7, atol=1e-10)
    power = fj.joint_efforts(SLIDE, (friction,), solution).total[:, 2] * exact
    np.testing.assert_allclose(
        power, -level * exact * np.tanh(exact / speed), rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: fj.forces.JointStops(1, 1), "lower: expected less than upper"),
        (lambda: fj.forces.JointStops(np.nan, 1), "lower: expected"),
        (
            lambda: fj.forces.JointStops(0, 1, stiffness=0),
            "stiffness: expected .* above 0",
        ),
        (
            lambda: fj.forces.JointStops(0, 1, smoothing=0),
            "smoothing: expected .* above 0",
        ),
        (
            lambda: fj.forces.JointStops(0, 1, damping=-1),
            "damping: expected .* at least 0",
        ),
        (lambda: fj.forces.JointFriction(-1), "level: expected .* at least 0"),
        (lambda: fj.forces.JointFriction(1, 0), "speed: expected .* above 0"),
    ],
)
def test_malformed_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
