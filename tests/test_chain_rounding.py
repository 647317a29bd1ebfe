"""Accelerations of chains of other lengths keep their digits, against 40 digits."""

import jax
import numpy as np
import pytest
from mpmath import mp

import fdof_jax as fj
from fdof_jax.mechanics.equations import zeros
from fdof_jax.simulation.vector_field import args_of, watched_field


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
        "R" * n,
        length=[0, *length],
        com=np.stack([length / 2, np.zeros(n)], axis=1),
        mass=[*(1 + np.arange(n - 1) / 4), tip_mass],
        inertia=length**2 / 16,
    )


def exact(arm, q, qd):
    """Returns M and the bias of M qdd + bias = tau, from absolute angles."""
    n, length = len(q), [*map(mp.mpf, arm.length.tolist()[1:])]
    angle = [mp.fsum(q[: k + 1]) for k in range(n)]
    rate = [mp.fsum(qd[: k + 1]) for k in range(n)]
    own, bias = mp.diag(arm.inertia.tolist()), mp.zeros(n, 1)
    for k, mass in enumerate(arm.mass.tolist()):
        arms = [*length[:k], mp.mpf(float(arm.com[k, 0]))]  # to the mass centre of k
        for i, a in enumerate(arms):
            bias[i] += mass * a * mp.mpf(float(arm.gravity)) * mp.cos(angle[i])
            for j, b in enumerate(arms):
                turn = angle[i] - angle[j]
                own[i, j] += mass * a * b * mp.cos(turn)
                bias[i] += mass * a * b * mp.sin(turn) * rate[j] ** 2
    sums = mp.matrix([[int(k <= i) for k in range(n)] for i in range(n)])
    return sums.T * own * sums, sums.T * bias


@pytest.fixture(autouse=True)
def many_digits():
    with mp.workdps(40):
        yield


@pytest.mark.parametrize("n", [2, 5])
def test_nearly_equal_rates_keep_their_digits(n):
    q = np.linspace(0.3, 0.9, n)
    qd = np.array([1e3, *(1e-9 * np.arange(1, n))])  # links that turn almost as one
    arm = rods(n).replace(gravity=0)
    mass, bias = exact(arm, q, qd)
    qdd, _ = at_an_instant(arm, q, qd)
    right = [float(x) for x in -(mass**-1 * bias)]
    np.testing.assert_allclose(np.array(qdd), right, rtol=1e-12)
    # Only differences of the links' rates load the ground.
    loads = [float(x) for x in bias]
    assert abs(loads[0]) < 1e-10 * abs(loads[1])
    np.testing.assert_allclose(fj.bias_force(arm, q, qd), loads, rtol=1e-12)


@pytest.mark.parametrize("n", [2, 5])
def test_a_million_turns_cost_no_digits(n):
    many = np.linspace(-2, 2, n) + 2 * np.pi * 1e6
    few = np.array([float(mp.mpf(angle) - 2 * mp.pi * 10**6) for angle in many])
    qd = np.linspace(1, -2, n)
    arm = rods(n).replace(base_angle=0.3)  # the sum of the angles would be rounded
    turned, plain = (np.array(at_an_instant(arm, q, qd)[0]) for q in (many, few))
    np.testing.assert_allclose(turned, plain, rtol=1e-12)


def test_a_motion_states_how_far_rounding_errors_are_amplified():
    arm, eps = rods(3, 1e3), 2.0**-52
    start = fj.State(np.array([0.3, -0.5, 0.4]), np.zeros(3))
    motion = fj.simulate(arm, start, np.linspace(0, 1, 101))
    q, stated = np.asarray(motion.q), motion.stats["accuracy"] / eps
    inverse = [(mass, mass**-1) for mass in (exact(arm, row, 0 * row)[0] for row in q)]
    losses = [[float(m[k, k] * i[k, k]) for k in range(3)] for m, i in inverse]
    # The steps and the samples meet the largest loss at other times.
    np.testing.assert_allclose(stated, np.max(losses), rtol=0.1)


@pytest.mark.parametrize("n", [2, 3, 5])
def test_health_states_the_loss_of_digits(n):
    # All joints of a straight arm move a heavy tip alike.
    q, qd = np.zeros(n), np.ones(n)
    for tip_mass in (1.0, 1e6):
        arm = rods(n, tip_mass)
        _, health = at_an_instant(arm, q, qd)
        mass, _ = exact(arm, q, qd)
        inverse = mass**-1
        right = [float(mass[k, k] * inverse[k, k]) for k in range(n)]
        np.testing.assert_allclose(np.array(health), right, rtol=1e-8)
        assert tip_mass < max(right) < 1000 * tip_mass
    _, health = at_an_instant(rods(n, 1e13), q, qd)
    assert not any(health)  # too much is lost
