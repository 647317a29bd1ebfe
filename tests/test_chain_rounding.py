"""Accelerations of chains of other lengths keep their digits, against 40 digits."""

import jax
import numpy as np
import pytest
from hard.oracle import Arm, chain, equations, floats
from mpmath import mp

import fdof_jax as fj
from fdof_jax.mechanics.equations import zeros
from fdof_jax.simulation.vector_field import args_of, watched_field

N = 5


@jax.jit
def at_an_instant(arm, q, qd):
    """Returns the accelerations as `simulate` computes them, and their health."""
    state = zeros(q), tuple(qd)
    (_, qdd), health = watched_field(0.0, state, args_of(arm, q, ()), ())
    return qdd, health


def rods(n, tip_mass=1.0):
    """Returns n revolute links, all of other lengths and masses."""
    length = 1 + np.arange(n) / 8
    return fj.Linkage(
        "R" * n, length=[0, *length], com=np.outer(length / 2, [1, 0]),
        mass=[*(1 + np.arange(n - 1) / 4), tip_mass], inertia=length**2 / 16,
    )  # fmt: skip


def exact(arm, q, qd):
    """Returns M, its inverse and the bias of M qdd + bias = tau."""
    fields = "length", "com", "mass", "inertia", "locked", "base_angle", "gravity"
    plain = Arm("R" * len(q), *(getattr(arm, name).tolist() for name in fields))
    mass, bias, _ = equations(plain, *chain(plain, q, qd))
    return mass, mass**-1, bias


def losses(arm, q):
    """Returns how far rounding errors of each acceleration are amplified."""
    mass, inverse, _ = exact(arm, q, 0 * q)
    return [float(mass[k, k] * inverse[k, k]) for k in range(len(q))]


@pytest.fixture(autouse=True)
def many_digits():
    with mp.workdps(40):
        yield


def test_nearly_equal_rates_keep_their_digits():
    q = np.linspace(0.3, 0.9, N)
    qd = np.array([1e3, *(1e-9 * np.arange(1, N))])  # links that turn almost as one
    arm = rods(N).replace(gravity=0)
    _, inverse, bias = exact(arm, q, qd)
    qdd, _ = at_an_instant(arm, q, qd)
    np.testing.assert_allclose(np.array(qdd), floats(-(inverse * bias)), rtol=1e-12)
    # Only differences of the links' rates load the ground.
    loads = floats(bias)
    assert abs(loads[0]) < 1e-10 * abs(loads[1])
    np.testing.assert_allclose(fj.bias_force(arm, q, qd), loads, rtol=1e-12)


def test_a_million_turns_cost_no_digits():
    many = np.linspace(-2, 2, N) + 2 * np.pi * 1e6
    few = np.array([float(mp.mpf(angle) - 2 * mp.pi * 10**6) for angle in many])
    arm = rods(N).replace(base_angle=0.3)  # the sum of the angles would be rounded
    qd = np.linspace(1, -2, N)
    turned, plain = (np.array(at_an_instant(arm, q, qd)[0]) for q in (many, few))
    np.testing.assert_allclose(turned, plain, rtol=1e-12)


def test_health_states_the_loss_of_digits():
    # All joints of a straight arm move a heavy tip alike.
    q, qd = np.zeros(N), np.ones(N)
    for tip_mass in (1.0, 1e6):
        arm = rods(N, tip_mass)
        _, health = at_an_instant(arm, q, qd)
        right = losses(arm, q)
        np.testing.assert_allclose(np.array(health), right, rtol=1e-8)
        assert tip_mass < max(right) < 1000 * tip_mass
    _, health = at_an_instant(rods(N, 1e13), q, qd)
    assert not any(health)  # too much is lost


@pytest.mark.slow
def test_a_motion_states_how_far_rounding_errors_are_amplified():
    arm, start = rods(3, 1e3), fj.State(np.array([0.3, -0.5, 0.4]), np.zeros(3))
    motion = fj.simulate(arm, start, np.linspace(0, 1, 101))
    stated = motion.stats["accuracy"] / 2.0**-52
    right = [losses(arm, q) for q in np.asarray(motion.q)]
    # The steps and the samples meet the largest loss at other times.
    np.testing.assert_allclose(stated, np.max(right), rtol=0.1)
