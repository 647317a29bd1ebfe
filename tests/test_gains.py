"""Gains from frequencies: the modes that they lead to."""

import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj

PENDULUM = fj.Linkage(
    "R", length=[0, 1], com=[[0.6, 0.2]], mass=[2], inertia=[0.3], gravity=9.81
)
STILL = np.zeros(3)


class Stand(fj.references.Reference):
    target: fj.Values = fj.field(unit="m or rad")

    def __call__(self, t, linkage):
        return self.target, 0 * self.target


def arm(topology, seed=0):
    rng = np.random.default_rng(seed)
    return random_linkage(topology, rng), rng.uniform(-1, 1, 3)


def pd_at(q, kp, kd):
    n = len(q)
    full = lambda value: np.broadcast_to(value, n).astype(float)
    return fj.PDController(full(kp), full(kd), full(np.inf), Stand(q))


def poles(linkage, q, *forces):
    A, _ = fj.linearize(linkage, fj.State(q, 0 * q), forces)
    return np.linalg.eigvals(A)


@pytest.mark.parametrize("joint", range(3))
def test_a_joint_that_moves_alone_has_the_frequency_and_the_damping(joint):
    linkage, q = arm("RRR")
    linkage = linkage.replace(gravity=0, locked=0)
    frequency, ratio = np.array([3.0, 5.0, 8.0]), np.array([0.2, 0.7, 1.0])
    gains = fj.control.gains_from_frequency(linkage, q, frequency, ratio)
    others = "".join("R" if k == joint else "F" for k in range(3))
    alone = linkage.replace(topology=others, locked=q)
    found = poles(alone, q, pd_at(q, *gains))
    omega, zeta = frequency[joint], ratio[joint]
    expected = np.roots([1, 2 * zeta * omega, omega**2])
    found = found[np.abs(found) > 1e-6]  # without those of the fixed pairs
    np.testing.assert_allclose(np.poly(found), np.poly(expected), rtol=1e-9)
    fixed = fj.control.gains_from_frequency(alone, q, frequency, ratio)
    np.testing.assert_allclose(fixed, np.eye(3)[joint] * gains, rtol=1e-12)


def test_gains_count_masses_of_elements():
    linkage, q = arm("RPR")
    bare = fj.control.gains_from_frequency(linkage, q, 4.0, 0.5)
    geared = fj.control.gains_from_frequency(
        linkage, q, 4.0, 0.5, (fj.forces.Armature([1.0, 2.0, 3.0]),)
    )
    more = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(geared[0] - bare[0], 16 * more, rtol=1e-12)
    np.testing.assert_allclose(geared[1] - bare[1], 4 * more, rtol=1e-12)


def test_a_joint_under_computed_torque_has_the_frequency_itself():
    linkage, q = arm("PRR")
    omega, zeta = 6.0, 0.4
    torque = fj.control.ComputedTorque(omega**2, 2 * zeta * omega, np.inf, Stand(q))
    expected = np.roots([1, 2 * zeta * omega, omega**2])
    found = poles(linkage, q, torque)
    np.testing.assert_allclose(np.abs(found), np.abs(expected[0]), rtol=1e-6)


@pytest.mark.parametrize(
    "frequency, ratio, message",
    [
        ([1, 2], 1, "frequency: expected an array of 3 real numbers for 3 joints"),
        (0, 1, r"frequency: .* above 0 \[rad/s\]"),
        (1, -0.1, "damping_ratio: .* at least 0"),
    ],
)
def test_impossible_frequencies_are_refused(frequency, ratio, message):
    linkage, q = arm("RRR")
    with pytest.raises(ValueError, match=message):
        fj.control.gains_from_frequency(linkage, q, frequency, ratio)
