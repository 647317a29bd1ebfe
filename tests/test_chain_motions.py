"""Derivatives of motions of chains with a fixed pair.

Motions of other numbers of joints than three are in tests/hard/test_motions.py.
"""

import chains
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT
from modes import ADJOINT, LOOPS

import fdof_jax as fj

pytestmark = pytest.mark.slow


def test_gradients_of_a_motion_equal_differences():
    """In reverse mode, with elements in arrays, with inertia and with a state.

    Forward mode is compared with a reference in tests/hard/test_motions.py.
    """
    topology, n = "FR", 2
    rng = np.random.default_rng(n)
    chain, weights = chains.random_chain(topology, rng), rng.normal(size=(2, n))
    ends = fj.Point(0, 3.0, -2.0), fj.Point(n, 0.3, 0.1)

    def value(arguments):
        chain, q, qd, damping, stiffness, rest_length, rotors, lag, effort = arguments
        options = dict(stiffness=stiffness, damping=0.5, rest_length=rest_length)
        forces = (
            fj.JointDamper(damping),
            fj.SpringDamper(*ends, **options),
            fj.forces.Armature(rotors),
            fj.control.FirstOrderLag(fj.JointEffort(effort), lag),
        )
        start = fj.State(q, qd)
        motion = fj.simulate(chain, start, [0, 0.1], forces, adjoint=ADJOINT, **SHORT)
        return jnp.sum(weights * jnp.stack([motion.q[-1], motion.qd[-1]]))

    q, qd = rng.normal(size=(2, n))
    damping, rotors, effort = rng.uniform(0.1, 1, (3, n))
    numbers = chain, q, qd, damping, 20.0, 0.4, rotors, 0.05, effort
    arguments = jax.tree.map(np.asarray, numbers)
    direction = jax.tree.map(lambda a: rng.normal(size=a.shape), arguments)
    direction = eqx.tree_at(lambda d: d[0].ef, direction, np.zeros(2 * n))
    both, h = jax.jit(jax.value_and_grad(value), **LOOPS), 1e-3
    products = jax.tree.map(np.vdot, both(arguments)[1], direction)
    moved = lambda s: jax.tree.map(lambda a, b: a + s * b, arguments, direction)
    at = lambda s: float(both(moved(s))[0])
    coarse, fine = ((at(s) - at(-s)) / (2 * s) for s in (h, h / 2))
    slope = float(sum(jax.tree.leaves(products)))
    assert slope == pytest.approx((4 * fine - coarse) / 3, rel=1e-8)
