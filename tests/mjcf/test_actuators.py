"""Elements with inertia: an independent Lagrangian of the actuator's bodies.

Their energies are tested with those of all elements, in test_elements.py, and the
armature against MuJoCo's in test_mjcf.py.
"""

import equinox as eqx
import numpy as np
import pytest
from helpers import random_motion

import fdof_jax as fj

PINS = fj.Point(0, -0.6, -0.8), fj.Point(2, 0.4, 0.3)
ACTUATOR = fj.LinearActuator(
    *PINS, force=5.0, mass=[1.2, 0.7], com=[0.2, 0.3], inertia=[0.05, 0.03]
)


def pins(linkage, q):
    """Returns the two pins as complex numbers, written out."""
    x, _ = fj.paper.to_chain(linkage, q, np.zeros(3))
    x = np.asarray(x)
    turn = np.exp(1j * np.array([linkage.base_angle, *x[1::2]]))
    start = np.cumsum((np.asarray(linkage.length)[:3] + 1j * x[0::2]) * turn[:3])
    return (-0.6 - 0.8j) * turn[0], start[1] + (0.4 + 0.3j) * turn[2]


def bodies(linkage, q):
    """Returns the mass centres and the angle of cylinder and piston."""
    a, b = pins(linkage, q)
    unit = (b - a) / abs(b - a)
    return a + 0.2 * unit, b - 0.3 * unit, np.angle(unit)


def lagrange(linkage, q, qd, qdd, h=1e-4):
    """Returns both bodies' generalised forces, by differences along the motion."""
    jacobian = []
    for e in np.eye(3):
        ahead, behind = bodies(linkage, q + h * e), bodies(linkage, q - h * e)
        jacobian.append([(x - y) / (2 * h) for x, y in zip(ahead, behind)])
    positions = [bodies(linkage, q + qd * t + qdd * t**2 / 2) for t in (-h, 0.0, h)]
    second = [(x - 2 * y + z) / h**2 for x, y, z in zip(*positions)]
    weight = 1j * float(linkage.gravity)
    pulls = [1.2 * (second[0] + weight), 0.7 * (second[1] + weight), 0.08 * second[2]]
    return np.array(
        [sum((np.conj(c) * p).real for c, p in zip(row, pulls)) for row in jacobian]
    )


@eqx.filter_jit
def acting(element, q, qd, linkage):
    return element(0.0, q, qd, linkage)


@pytest.mark.slow
@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_the_actuator_s_bodies_by_another_lagrangian(topology):
    linkage, q, qd = random_motion(topology)
    qdd = np.array([0.3, -0.7, 1.1])
    bare = fj.inverse_dynamics(linkage, q, qd, qdd)
    full = fj.inverse_dynamics(linkage, q, qd, qdd, (ACTUATOR,))
    exact = lagrange(linkage, q, qd, qdd)
    assert np.abs(exact).max() > 0.05
    np.testing.assert_allclose(full - bare, exact, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_the_actuator_s_force_does_its_power(topology):
    linkage, q, qd = random_motion(topology)
    a, b = (np.array(pins(linkage, q + h * qd)) for h in (1e-6, -1e-6))
    rate = (abs(a[1] - a[0]) - abs(b[1] - b[0])) / 2e-6
    power = np.asarray(acting(ACTUATOR, q, qd, linkage)) @ qd
    np.testing.assert_allclose(power, 5.0 * rate, atol=1e-8)


def test_the_actuator_s_force_may_depend_on_its_length():
    linkage, q, qd = random_motion("RRR")
    spring = fj.LinearActuator(*PINS, force=lambda t, length, rate: -30 * length - rate)
    same = fj.SpringDamper(*PINS, stiffness=30.0, damping=1.0)
    np.testing.assert_allclose(
        spring(0.0, q, qd, linkage), same(0.0, q, qd, linkage), rtol=1e-12
    )


@pytest.mark.slow
def test_a_rotor_of_a_direct_drive_turns_as_the_link_beyond():
    linkage, q, qd = random_motion("RRR")
    rotors, inertia = fj.forces.Rotor([0.3, 0.2, 0.1], 1.0), [0.3, 0.2, 0.1]
    heavy = linkage.replace(inertia=linkage.inertia + np.array(inertia))
    for of, *at in ((fj.mass_matrix, q), (fj.bias_force, q, qd), (fj.energy, q, qd)):
        found, expected = of(linkage, *at, (rotors,)), of(heavy, *at)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_a_rotor_of_a_high_ratio_is_an_armature():
    """The coupling of the joints is 1 / gear of the armature's own."""
    linkage, q, _ = random_motion("RPR")
    matrix = lambda element: fj.mass_matrix(linkage, q, (element,))
    own = np.array([0.3, 0.2, 0.4])
    for gear in (5.0, 50.0):
        found = matrix(fj.forces.Rotor(own / gear**2, gear))
        coupling = np.zeros((3, 3))
        coupling[0] = coupling[:, 0] = [0, *own[1:] / gear]
        coupling[0, 0] = own[1:].sum() / gear**2
        expected = matrix(fj.forces.Armature(own)) + coupling
        np.testing.assert_allclose(found, expected, atol=1e-13)


def test_the_conditioning_sees_the_armature():
    """Checks that a heavy rotor makes a light tip on a heavy arm well-conditioned."""
    linkage = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 1e6],
        inertia=[1 / 12] * 3,
    )  # fmt: skip
    q = np.array([0.1, 0.2, 0.3])
    assert fj.analysis.inertia_ratios(linkage, q).min() < 1e-4
    assert (
        fj.analysis.inertia_ratios(linkage, q, (fj.forces.Armature(1e9),)).min() > 0.9
    )
