"""Springs, stops, friction and histories of efforts: closed forms, derivatives.

Their energies are tested with those of all elements, in test_elements.py.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import fdof_jax as fj
from fdof_jax.forces import EffortHistory, JointFriction, JointSpring, JointStops

# A point mass that slides along y, and efforts of any arm of three joints.
SLIDE = fj.Linkage("P", length=[0, 0], com=[[0, 0]], mass=[2], inertia=[1], gravity=0.0)
ARM, OUT = fj.scenes.fig5().linkage, np.array([1.0, -1.0, 1.0])
INF, K, D = np.inf, 300.0, 0.3
ENDS = JointStops([-INF, -1, -INF], [1, INF, 1], stiffness=K, damping=D)
ROUNDED = ENDS.replace(smoothing=0.1)


SPRING = JointSpring([30.0, 0, 7], [-0.5, 0.2, 0.1])
PLAIN = JointStops([-1, -INF, -2], [1, 2, INF])


@pytest.mark.parametrize("element, q, qd, expected", [
    (SPRING, [3.9, -9, 0.4], 0, [-132, 0, -2.1]),  # beyond half a turn, too
    (fj.JointEffort(1.5), 0, 0, 1.5),
    (JointFriction(4.0, speed=0.05), 0, 0.1 * OUT, -4 * np.tanh(2) * OUT),
    # Damped stops push by their law and never pull.
    (ENDS, 1.1 * OUT, -50 * OUT, 0),
    (ENDS, 1.02 * OUT, 3 * OUT, -K * 0.02 * (1 + D * 3) * OUT),
    (ROUNDED, 1.02 * OUT, 3 * OUT, -K * 0.12**2 / 0.4 * (1 + D * 3) * OUT),
    # Within the range they do nothing, and outside they push back.
    (PLAIN, [0.5, -1e30, 1e30], 0, 0),
    (PLAIN, [-1.5, 3, -2.5], 0, [5e3, -1e4, 5e3]),
])  # fmt: skip
def test_efforts_of_a_state(element, q, qd, expected):
    q, qd, expected = (np.broadcast_to(a, 3).astype(float) for a in (q, qd, expected))
    found = element(0.0, jnp.asarray(q), jnp.asarray(qd), ARM)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def speed_by_law(speed, damping):
    """v dv / (1 + d v) = -k/m p dp: its integral is equal before and after a blow."""
    integral = lambda v: v / damping - np.log1p(damping * v) / damping**2
    lost = lambda back: integral(-back) - integral(speed)
    return brentq(lost, 1e-9, min(speed, (1 - 1e-12) / damping), xtol=1e-14)


def rebound(speed, mass, stiffness, damping, share=None):
    """Returns the speed after a blow; `share` is that of an elastic blow's depth."""
    depth = speed * jnp.sqrt(mass / stiffness)
    smoothing = None if share is None else share * depth
    options = dict(stiffness=stiffness, damping=damping, smoothing=smoothing)
    near = 2 * (depth if share is None else depth + smoothing)
    slide = eqx.tree_at(lambda arm: arm.mass, SLIDE, mass[None])
    start = fj.State((1 - near)[None], speed[None])
    end = 200 * near / speed * (1 + damping * speed)
    stops = JointStops(-INF, 1.0, **options)
    return -fj.simulate(slide, start, jnp.stack([0 * end, end]), (stops,)).qd[-1, 0]


with_slope, smoothed = jax.jit(jax.value_and_grad(rebound)), jax.jit(rebound)


@pytest.mark.slow
def test_a_rebound_loses_what_the_law_says():
    """Smoothing takes nothing from it; derivatives are known where there is none."""
    blows = itertools.product([0.1, 10.0], [0.01, 100.0], [1e2, 1e7], [0.01, 2.0])
    for blow in blows:
        speed, *_, damping = blow = [jnp.asarray(number) for number in blow]
        expected = speed_by_law(speed, damping)
        back, slope = with_slope(*blow)
        change = lambda v, d=damping: v / (1 + d * v)  # of the integral
        np.testing.assert_allclose(slope, change(speed) / -change(-expected), rtol=1e-5)
        for found in (back, *(smoothed(*blow, share) for share in (0.03, 1.0, 100.0))):
            np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize("smoothing", [None, 1e-3])
def test_stops_have_finite_derivatives_everywhere(smoothing):
    push = jax.jit(lambda q, qd, stops: stops(0.0, q, qd, None))
    reverse, ones = jax.jit(jax.jacrev(push, (0, 1))), np.ones(3)
    stops = JointStops(-1.0, [1.0, INF, 1e300], damping=0.5, smoothing=smoothing)
    for x in (-1e30, -1.0, 0.0, 1.0, 1e12):
        assert all(np.isfinite(s).all() for s in reverse(np.full(3, x), ones, stops))
    finite, h = eqx.tree_at(lambda s: s.upper, stops, jnp.ones(3)), 1e-7
    for k in {0, 1, 3, 4} | ({2} if smoothing else set()):  # at the end the slope jumps
        q = np.full(3, 0.9995 + 2.5e-4 * k)
        slope, _ = reverse(q, ones, finite)
        ahead, behind = (np.asarray(push(q + s, ones, finite)) for s in (h, -h))
        difference = (ahead - behind) / (2 * h)
        np.testing.assert_allclose(np.diag(slope), difference, rtol=1e-5, atol=1e-3)


def test_efforts_are_linear_between_the_times_and_held_beyond():
    ts, zero = np.array([0.1, 0.25, 0.3, 0.62]), np.zeros(3)
    tau = np.random.default_rng(0).normal(size=(4, 3))
    history = EffortHistory(ts, tau)
    times = np.array([-1, 0.1, 0.17, 0.25, 0.299, 0.5, 0.62, 3])
    found = jax.vmap(lambda t: history(t, zero, zero, None))(times)
    expected = np.stack([np.interp(times, ts, column) for column in tau.T], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_array_equal(history.jump_ts, ts)
    constant = EffortHistory([0.5], tau[:1])
    np.testing.assert_array_equal(constant(0.7, zero, zero, None), tau[0])
