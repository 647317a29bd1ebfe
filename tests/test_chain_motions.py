"""Motions of chains of other numbers of joints than three, and their derivatives."""

import json
from pathlib import Path

import chains
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT
from modes import ADJOINT, LOOPS

import fdof_jax as fj

REFERENCE = json.loads((Path(__file__).parent / "hard/reference.json").read_text())
FIELDS = "length", "com", "mass", "inertia", "locked", "base_angle", "gravity"


# Ten times the errors that were found: at the end of the motion and, interpolated,
# before. The double pendulum multiplies errors by 5000.
@pytest.mark.slow
@pytest.mark.parametrize(
    "name, at_end, before",
    [("double-pendulum", 2e-8, 2e-8), ("cart-pole", 3e-11, 5e-10)],
)
def test_motions_equal_the_reference(name, at_end, before):
    values = REFERENCE[name]
    arm = fj.Linkage(values["topology"], **{field: values[field] for field in FIELDS})
    start = fj.State(values["q0"], values["qd0"])
    forces = fj.JointEffort(values["effort"]), fj.JointDamper(values["damping"])
    ts = np.linspace(0, values["t1"], len(values["q"]))
    motion = fj.simulate(arm, start, ts, forces)
    error = np.abs(motion.q - np.asarray(values["q"])).max(axis=1)
    assert error[-1] <= at_end and error.max() <= before


@pytest.mark.slow
def test_the_two_link_arm_on_its_circle_equals_the_reference():
    arm, start, forces, t1 = fj.scenes.two_link_circle()
    wanted = REFERENCE["two-link-circle"]
    np.testing.assert_allclose(start.q, wanted["q0"], atol=1e-15)
    motion = fj.simulate(arm, start, np.linspace(0, t1, len(wanted["q"])), forces)
    np.testing.assert_allclose(motion.q, wanted["q"], atol=2e-10)
    np.testing.assert_allclose(motion.q[-1], wanted["q"][-1], atol=1e-12)


@pytest.mark.slow
def test_gradients_of_a_motion_equal_differences():
    """In reverse mode, with elements in arrays, with inertia and with a state.

    Forward mode is compared with a reference in tests/hard/test_motions.py.
    """
    topology, n = "PFR", 3
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
