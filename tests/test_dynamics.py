"""Identities that hold for every linkage, state and effort."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from helpers import random_linkage
from hypothesis import given, settings, strategies as st

import fdof_jax as fj


@jax.jit
def everything(linkage, q, qd, tau, force):
    """Returns what the identities compare, in joint and in the paper's coordinates."""
    x, xd = fj.paper.to_chain(linkage, q, qd)
    qdd = fj.forward_dynamics(linkage, q, qd, tau)
    energies = lambda q, qd: fj.energy(linkage, q, qd)
    energy, rate = jax.jvp(energies, (q, qd), (qd, qdd))
    at_rest = lambda qdd: fj.inverse_dynamics(linkage, q, 0 * q, qdd)
    chain = lambda q: fj.paper.to_chain(linkage, q, qd)[0]
    # Efforts of joints are those of the chain's real joints, and 0 at fictitious ones.
    scattered = linkage.ef * jnp.repeat(tau, 2)
    return dict(
        xd=xd,
        kinetic=energy[0],
        power=sum(rate),
        inverse=fj.inverse_dynamics(linkage, q, qd, qdd),
        matrix=fj.mass_matrix(linkage, q),
        inverse_matrix=jax.jacfwd(at_rest)(0 * q),
        full=fj.paper.mass_matrix(linkage, x),
        slopes=jax.jacfwd(chain)(q),
        masked=fj.paper.masked_accelerations(linkage, x, xd, scattered),
        # Accelerations are mapped as rates are.
        reduced=fj.paper.to_chain(linkage, q, qdd)[1],
        xdd=fj.paper.masked_accelerations(linkage, x, xd, force),
        constraint=fj.paper.constraint_forces(linkage, x, xd, force),
        bias=fj.paper.bias_force(linkage, x, xd),
    )


@given(st.sampled_from(fj.TOPOLOGIES), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_identities(topology, seed):
    rng = np.random.default_rng(seed)
    linkage = random_linkage(topology, rng)
    (q, qd, tau), force = rng.normal(size=(3, 3)), rng.normal(size=6)
    found = everything(linkage, q, qd, tau, force)
    v = {name: np.asarray(value) for name, value in found.items()}
    close = functools.partial(np.testing.assert_allclose, rtol=1e-9)

    # The mass matrix: symmetric, positive, that of the chain and of the energy.
    for matrix in (v["full"], v["matrix"]):
        np.testing.assert_array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(v["matrix"]).min() > 0
    projected = v["slopes"].T @ v["full"] @ v["slopes"]
    for matrix in (v["matrix"], v["inverse_matrix"]):
        close(matrix, projected, atol=1e-12)
    close(v["xd"] @ v["full"] @ v["xd"] / 2, v["kinetic"], rtol=1e-12, atol=1e-13)

    # Motion: masked as in the paper, its inverse, and its power.
    scale = 1 + np.abs(v["reduced"]).max()
    close(v["masked"], v["reduced"], rtol=0, atol=1e-11 * scale)
    close(v["inverse"], tau, atol=1e-10)
    close(v["power"], tau @ qd, atol=1e-9)

    # With constraint forces, (15) gives the same accelerations without masks.
    balance = force + v["constraint"]
    balance[1:5:2] -= (force + v["constraint"])[3::2]
    close(v["full"] @ v["xdd"] - v["bias"], balance, atol=1e-9)


@jax.jit
def accelerations(linkage, mass, length, q, qd, tau):
    linkage = eqx.tree_at(lambda x: (x.mass, x.length), linkage, (mass, length))
    return fj.forward_dynamics(linkage, q, qd, tau)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_forward_dynamics_derivatives(topology):
    rng = np.random.default_rng(1)
    linkage = random_linkage(topology, rng)
    arguments = linkage.mass, linkage.length, *jnp.asarray(rng.normal(size=(3, 3)))
    function = functools.partial(accelerations, linkage)
    jax.test_util.check_grads(function, arguments, order=1)


def test_vmap_over_topologies_equals_singles():
    rng = np.random.default_rng(2)
    linkages = [random_linkage(topology, rng) for topology in fj.TOPOLOGIES]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *linkages)
    states = rng.normal(size=(7, 3, 3))
    together = jax.jit(jax.vmap(lambda arm, row: fj.forward_dynamics(arm, *row)))
    alone = [fj.forward_dynamics(arm, *row) for arm, row in zip(linkages, states)]
    np.testing.assert_allclose(together(batch, states), alone, rtol=1e-12, atol=1e-12)
