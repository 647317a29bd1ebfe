"""Elements with inertia: energies and efforts of their bodies, written out.

That their efforts follow from their energies is tested in test_elements.py, and the
armature against MuJoCo's in test_mjcf_reading.py.
"""

import numpy as np
import pytest
from helpers import random_motion

import fdof_jax as fj

PINS = fj.Point(0, -0.6, -0.8), fj.Point(2, 0.4, 0.3)
ACTUATOR = fj.LinearActuator(
    *PINS, force=5.0, mass=[1.2, 0.7], com=[0.2, 0.3], inertia=[0.05, 0.03]
)


def bodies(linkage, q):
    """Returns mass centres of cylinder and piston, their direction and the length."""
    x, _ = fj.paper.to_chain(linkage, q, np.zeros(3))
    x = np.asarray(x)
    turn = np.exp(1j * np.array([linkage.base_angle, *x[1::2]]))
    start = np.cumsum((np.asarray(linkage.length)[:3] + 1j * x[0::2]) * turn[:3])
    a, b = (-0.6 - 0.8j) * turn[0], start[1] + (0.4 + 0.3j) * turn[2]
    unit = (b - a) / abs(b - a)
    return np.array([a + 0.2 * unit, b - 0.3 * unit, unit, abs(b - a)])


@pytest.mark.parametrize("topology", ["RRR", "PRP"])
def test_the_actuator_s_energies_and_power(topology, h=1e-6):
    linkage, q, qd = random_motion(topology)
    at, *ends = (bodies(linkage, q + s * h * qd) for s in (0, 1, -1))
    cylinder, piston, turn, stretch = np.subtract(*ends) / (2 * h)
    kinetic = 1.2 * abs(cylinder) ** 2 + 0.7 * abs(piston) ** 2 + 0.08 * abs(turn) ** 2
    potential = linkage.gravity * (1.2 * at[0] + 0.7 * at[1]).imag
    bare, full = (fj.energy(linkage, q, qd, own) for own in ((), (ACTUATOR,)))
    found = np.subtract(full, bare)
    np.testing.assert_allclose(found, (kinetic / 2, potential), rtol=1e-7)
    effort = np.asarray(ACTUATOR(0.0, q, qd, linkage))
    np.testing.assert_allclose(effort @ qd, 5.0 * stretch.real, atol=1e-8)


def test_the_actuator_s_force_may_depend_on_its_length():
    linkage, q, qd = random_motion("RRR")
    spring = fj.LinearActuator(*PINS, force=lambda t, length, rate: -30 * length - rate)
    same = fj.SpringDamper(*PINS, stiffness=30.0, damping=1.0)
    found, expected = (element(0.0, q, qd, linkage) for element in (spring, same))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("gear", [1.0, 5.0])
def test_a_rotor_is_an_armature_and_couples_its_joint_to_those_before(gear):
    """With a gear of 1 it turns as the link beyond it."""
    linkage, q, _ = random_motion("RPR")
    matrix = lambda element: fj.mass_matrix(linkage, q, (element,))
    own = np.array([0.3, 0.2, 0.4])
    found = matrix(fj.forces.Rotor(own / gear**2, gear))
    coupling = np.zeros((3, 3))
    coupling[0] = coupling[:, 0] = [0, *own[1:] / gear]
    coupling[0, 0] = own[1:].sum() / gear**2
    expected = matrix(fj.forces.Armature(own)) + coupling
    np.testing.assert_allclose(found, expected, atol=1e-13)
