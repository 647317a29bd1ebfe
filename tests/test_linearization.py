"""Linear analysis: differences, the exponential of A, equilibria, the regressor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj
from fdof_jax.linearization import (
    equilibrium,
    holding_efforts,
    inertial_parameters,
    linearize,
    regressor,
)


def motion(topology, seed=0):
    rng = np.random.default_rng(seed)
    return random_linkage(topology, rng), *rng.uniform(-1, 1, (3, 3))


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_the_regressor_times_the_parameters_is_the_inverse_dynamics(topology):
    linkage, q, qd, qdd = motion(topology)
    matrix = regressor(linkage, q, qd, qdd)
    tau = jnp.einsum("jlp,lp->j", matrix, inertial_parameters(linkage))
    exact = fj.inverse_dynamics(linkage, q, qd, qdd)
    np.testing.assert_allclose(tau, exact, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_a_and_b_are_slopes(topology):
    linkage, q, qd, tau = motion(topology)
    forces = fj.JointDamper(0.3), fj.JointEffort(tau), fj.Armature(0.2)
    A, B = linearize(linkage, forces, fj.State(q, qd))

    def rates(y, effort):
        total = tau - 0.3 * y[3:] + effort
        qdd = fj.forward_dynamics(linkage, y[:3], y[3:], total, forces)
        return np.concatenate([y[3:], qdd])

    y, h = np.concatenate([q, qd]), 1e-6
    none = np.zeros(3)
    by_y = [
        (rates(y + h * e, none) - rates(y - h * e, none)) / 2 / h for e in np.eye(6)
    ]
    by_u = [(rates(y, h * e) - rates(y, -h * e)) / 2 / h for e in np.eye(3)]
    np.testing.assert_allclose(A, np.transpose(by_y), atol=1e-7 * np.abs(A).max())
    np.testing.assert_allclose(B, np.transpose(by_u), atol=1e-7 * np.abs(B).max())


def test_an_arm_that_hangs_is_in_equilibrium():
    arm = fj.Linkage(
        "RRR",
        length=[0, 1, 1, 1],
        com=[[0.5, 0]] * 3,
        mass=[1] * 3,
        inertia=[1 / 12] * 3,
    )
    q = equilibrium(arm, (), [-1.4, 0.1, -0.1])
    np.testing.assert_allclose(q, [-np.pi / 2, 0, 0], atol=1e-9)
    eigenvalues = np.linalg.eigvals(linearize(arm, (), fj.State(q, np.zeros(3))).A)
    assert np.abs(eigenvalues.real).max() < 1e-6 and np.abs(eigenvalues.imag).min() > 1


def test_held_arms_stay():
    linkage, q, *_ = motion("RPR")
    forces = (fj.JointEffort(holding_efforts(linkage, q)),)
    np.testing.assert_allclose(equilibrium(linkage, forces, q + 1e-3), q, atol=1e-8)
    qdd = fj.forward_dynamics(linkage, q, np.zeros(3), forces[0].tau)
    np.testing.assert_allclose(qdd, 0, atol=1e-9)
    nowhere = equilibrium(linkage, (fj.JointEffort([1e6, 0, 0]),), q)
    assert np.isnan(nowhere).all()


def test_stateful_elements_are_refused():
    linkage, q, qd, _ = motion("RPR")
    lag = fj.FirstOrderLag(fj.JointEffort(np.ones(3)), 0.1)
    with pytest.raises(ValueError, match="forces: expected elements without"):
        linearize(linkage, (lag,), fj.State(q, qd))
    assert jax.tree.leaves(lag)
