"""Motions of chains of other numbers of joints than three, and their derivatives."""

import json
from pathlib import Path

import chains
import diffrax
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


def scene(name):
    """Returns the linkage, the start, the forces and the times of a reference."""
    values = REFERENCE[name]
    arm = fj.Linkage(values["topology"], **{field: values[field] for field in FIELDS})
    start = fj.State(*jnp.asarray([values["q0"], values["qd0"]]))
    forces = fj.JointEffort(values["effort"]), fj.JointDamper(values["damping"])
    return arm, start, forces, np.linspace(0, values["t1"], len(values["q"]))


# Ten times the errors that were found: at the end of the motion and, interpolated,
# before. The double pendulum multiplies errors by 5000.
BOUNDS = {
    "two-links": (1e-10, 1e-9),
    "double-pendulum": (2e-8, 2e-8),
    "cart-pole": (3e-11, 5e-10),
    "five-links": (6e-12, 8e-10),
    "six-pairs": (2e-12, 3e-10),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BOUNDS)
def test_motions_equal_the_reference(name):
    arm, start, forces, ts = scene(name)
    motion = fj.simulate(arm, start, ts, forces)
    error = np.abs(motion.q - np.asarray(REFERENCE[name]["q"])).max(axis=1)
    at_end, before = BOUNDS[name]
    assert error[-1] <= at_end
    assert error.max() <= before


@pytest.mark.slow
def test_the_two_link_arm_on_its_circle_equals_the_reference():
    arm, start, forces, t1 = fj.scenes.two_link_circle()
    wanted = REFERENCE["two-link-circle"]
    np.testing.assert_allclose(start.q, wanted["q0"], atol=1e-15)
    motion = fj.simulate(arm, start, np.linspace(0, t1, len(wanted["q"])), forces)
    np.testing.assert_allclose(motion.q, wanted["q"], atol=2e-10)
    np.testing.assert_allclose(motion.q[-1], wanted["q"][-1], atol=1e-12)


# Forward mode for six pairs, and for three in tests/hard/test_chaos.py; reverse mode,
# which takes long to compile, for two here and for three, one of them fixed, in
# `test_gradients_of_a_motion_equal_differences`.
@pytest.mark.slow
@pytest.mark.parametrize(
    "name, bound, mode",
    [("double-pendulum", 2e-9, "reverse"), ("six-pairs", 4e-12, "forward")],
)
def test_derivatives_of_motions_equal_the_reference(name, bound, mode):
    arm, start, forces, ts = scene(name)
    adjoint = diffrax.ForwardMode() if mode == "forward" else ADJOINT

    def end(q0, mass):
        linkage = eqx.tree_at(lambda arm: arm.mass, arm, mass)
        state0 = start._replace(q=q0)
        return fj.simulate(linkage, state0, ts[[0, -1]], forces, adjoint=adjoint).q[-1]

    transform = jax.jacfwd if mode == "forward" else jax.jacrev
    slopes = jax.jit(transform(end, (0, 1)), **LOOPS)(start.q, arm.mass)
    for argument, slope in zip(("dq_dq0", "dq_dmass"), slopes):
        if argument in REFERENCE[name]:
            expected = np.asarray(REFERENCE[name][argument])
            within = bound * np.abs(expected).max()
            np.testing.assert_allclose(slope, expected, rtol=0, atol=within)


@pytest.mark.slow
def test_gradients_of_a_motion_equal_differences():
    """In reverse mode, with elements in arrays, with inertia and with a state."""
    topology, n = "PFR", 3
    rng = np.random.default_rng(n)
    chain = chains.random_chain(topology, rng)
    weights = rng.normal(size=(2, n))
    ends = fj.Point(0, 3.0, -2.0), fj.Point(n, 0.3, 0.1)

    def value(arguments):
        chain, q, qd, damping, stiffness, rest_length, rotors, lag, effort = arguments
        spring = fj.SpringDamper(
            *ends, stiffness=stiffness, damping=0.5, rest_length=rest_length
        )
        forces = (
            fj.JointDamper(damping),
            spring,
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
    both = jax.jit(jax.value_and_grad(value), **LOOPS)
    _, gradient = both(arguments)
    products = jax.tree.map(np.vdot, gradient, direction)
    slope = float(sum(jax.tree.leaves(products)))

    def shifted(step):
        moved = jax.tree.map(lambda a, b: a + step * b, arguments, direction)
        return float(both(moved)[0])

    h = 1e-3
    coarse, fine = ((shifted(s) - shifted(-s)) / (2 * s) for s in (h, h / 2))
    assert slope == pytest.approx((4 * fine - coarse) / 3, rel=1e-8)
