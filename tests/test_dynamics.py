"""Identities that hold for every linkage, state and effort."""

import functools

import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from helpers import random_linkage
from hypothesis import given, settings, strategies as st

import fdof_jax as fj

cases = st.tuples(st.sampled_from(fj.TOPOLOGIES), st.integers(0, 2**32 - 1))
identities = settings(max_examples=60, deadline=None)


def draw(case):
    topology, seed = case
    rng = np.random.default_rng(seed)
    return random_linkage(topology, rng), *rng.normal(size=(3, 3)), rng


@jax.jit
def projected(linkage, q):
    """Returns the reduced mass matrix, column by column from inverse dynamics."""
    at_rest = jnp.zeros(3)
    return jax.jacfwd(lambda a: fj.inverse_dynamics(linkage, q, at_rest, a))(at_rest)


@jax.jit
def chain_slopes(linkage, q, qd):
    return jax.jacfwd(lambda q: fj.paper.to_chain(linkage, q, qd)[0])(q)


@jax.jit
def energy_rate(linkage, q, qd, qdd):
    energies = lambda q, qd: sum(fj.energy(linkage, q, qd))
    return jax.jvp(energies, (q, qd), (qd, qdd))[1]


def scatter(linkage, values):
    """Returns joint quantities at the chain's real joints, 0 at fictitious ones."""
    return np.asarray(linkage.ef) * np.repeat(values, 2)


@given(cases)
@identities
def test_mass_matrices_are_symmetric_and_positive(case):
    linkage, q, qd, _, rng = draw(case)
    x, _ = fj.paper.to_chain(linkage, q, qd)
    M = np.asarray(fj.paper.mass_matrix(linkage, x))
    np.testing.assert_array_equal(M, M.T)
    reduced = np.asarray(fj.mass_matrix(linkage, q))
    np.testing.assert_array_equal(reduced, reduced.T)
    assert np.linalg.eigvalsh(reduced).min() > 0


@given(cases)
@identities
def test_reduced_mass_matrix_is_the_projected_one(case):
    linkage, q, qd, _, _ = draw(case)
    x, _ = fj.paper.to_chain(linkage, q, qd)
    S = np.asarray(chain_slopes(linkage, q, qd))
    full = np.asarray(fj.paper.mass_matrix(linkage, x))
    for reduced in (projected(linkage, q), fj.mass_matrix(linkage, q)):
        np.testing.assert_allclose(reduced, S.T @ full @ S, atol=1e-12)


@given(cases)
@identities
def test_kinetic_energy_is_that_of_the_mass_matrix(case):
    linkage, q, qd, _, _ = draw(case)
    x, xd = map(np.asarray, fj.paper.to_chain(linkage, q, qd))
    kinetic, _ = fj.energy(linkage, q, qd)
    full = xd @ np.asarray(fj.paper.mass_matrix(linkage, x)) @ xd / 2
    np.testing.assert_allclose(full, kinetic, rtol=1e-12, atol=1e-13)


@given(cases)
@identities
def test_masked_equals_reduced(case):
    linkage, q, qd, tau, _ = draw(case)
    x, xd = fj.paper.to_chain(linkage, q, qd)
    masked = fj.paper.masked_accelerations(linkage, x, xd, scatter(linkage, tau))
    qdd = fj.forward_dynamics(linkage, q, qd, tau)
    # Joint to chain accelerations is linear, with the same map as the rates.
    _, expected = fj.paper.to_chain(linkage, q, qdd)
    scale = 1 + np.abs(expected).max()
    np.testing.assert_allclose(masked, expected, atol=1e-11 * scale)


@given(cases)
@identities
def test_inverse_after_forward_is_the_identity(case):
    linkage, q, qd, tau, _ = draw(case)
    qdd = fj.forward_dynamics(linkage, q, qd, tau)
    np.testing.assert_allclose(
        fj.inverse_dynamics(linkage, q, qd, qdd), tau, rtol=1e-9, atol=1e-10
    )


@given(cases)
@identities
def test_power_balance(case):
    linkage, q, qd, tau, _ = draw(case)
    qdd = fj.forward_dynamics(linkage, q, qd, tau)
    rate = energy_rate(linkage, q, qd, qdd)
    np.testing.assert_allclose(rate, tau @ qd, rtol=1e-9, atol=1e-9)


@given(cases)
@identities
def test_constraint_forces_close_the_balance_of_the_chain(case):
    """With constraint forces, (15) gives the same accelerations without masks."""
    linkage, q, qd, tau, rng = draw(case)
    x, xd = fj.paper.to_chain(linkage, q, qd)
    force = rng.normal(size=6)
    xdd = fj.paper.masked_accelerations(linkage, x, xd, force)
    total = force + np.asarray(fj.paper.constraint_forces(linkage, x, xd, force))
    generalised = total.copy()
    generalised[1:5:2] -= total[3::2]
    inertial = np.asarray(fj.paper.mass_matrix(linkage, x)) @ np.asarray(xdd)
    balance = inertial - np.asarray(fj.paper.bias_force(linkage, x, xd))
    np.testing.assert_allclose(balance, generalised, rtol=1e-9, atol=1e-9)


@jax.jit
def accelerations(linkage, mass, length, q, qd, tau):
    changed = eqx.tree_at(lambda x: (x.mass, x.length), linkage, (mass, length))
    return fj.forward_dynamics(changed, q, qd, tau)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_forward_dynamics_derivatives(topology):
    rng = np.random.default_rng(1)
    linkage = random_linkage(topology, rng)
    q, qd, tau = jnp.asarray(rng.normal(size=(3, 3)))

    jax.test_util.check_grads(
        functools.partial(accelerations, linkage),
        (linkage.mass, linkage.length, q, qd, tau),
        order=1,
    )


def test_vmap_over_topologies_equals_singles():
    rng = np.random.default_rng(2)
    linkages = [random_linkage(t, rng) for t in fj.TOPOLOGIES]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *linkages)
    q, qd, tau = rng.normal(size=(3, 7, 3))
    together = jax.jit(jax.vmap(fj.forward_dynamics))(batch, q, qd, tau)
    for i, linkage in enumerate(linkages):
        single = fj.forward_dynamics(linkage, q[i], qd[i], tau[i])
        np.testing.assert_allclose(together[i], single, rtol=1e-12, atol=1e-12)


def test_mass_matrix_and_bias_are_those_of_the_accelerations():
    rng = np.random.default_rng(4)
    for topology in fj.TOPOLOGIES:
        arm = elements.arm(topology)
        forces = tuple(elements.WITH_INERTIA.values())
        q, qd, tau = rng.uniform(-1, 1, (3, 3))
        matrix = np.asarray(fj.mass_matrix(arm, q, forces))
        qdd = fj.forward_dynamics(arm, q, qd, tau, forces)
        bias = fj.bias_force(arm, q, qd, forces)
        np.testing.assert_allclose(matrix @ qdd + bias, tau, atol=1e-11)
        np.testing.assert_array_equal(matrix, matrix.T)
        assert np.linalg.eigvalsh(matrix).min() > 0
