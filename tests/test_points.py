"""Springs, wrenches and actuators at points of links: places, loads, times and sides.

That efforts follow from energies is tested in test_elements.py, and springs and
armatures against MuJoCo's in test_mjcf_reading.py.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_motion

import fdof_jax as fj
from fdof_jax.linkage.frames import scalar_frames

A, B = fj.Point(0, 0.3, -0.4), fj.Point(3, 0.5, 0.2)
# A force and a moment that rise, to those of the test at 0.5 s.
RISING = dict(force=lambda t: jnp.stack([6 * t, -4 * t]), moment=lambda t: 3 * t)


# One program for each kind of element, instead of one for each operation.
@eqx.filter_jit
def effort(element, q, qd, linkage, t=0.0):
    return element(t, q, qd, linkage)


@eqx.filter_jit
def place_and_velocity(point, linkage, q, qd):
    frames = scalar_frames(linkage, tuple(q))
    of = lambda q: point.position(linkage, q)
    return jax.jvp(of, (q,), (qd,)), point.velocity(frames, tuple(qd))


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_a_point_lies_where_the_links_are_and_moves_with_them(topology):
    linkage, q, qd = random_motion(topology)
    x, _ = fj.paper.to_chain(linkage, q, qd)
    starts = [np.zeros(2), *np.asarray(fj.joint_positions(linkage, q))]
    for link, angle in enumerate([linkage.base_angle, *x[1::2]]):
        point = fj.Point(link, 0.3, -0.2)
        found = place_and_velocity(point, linkage, jnp.asarray(q), jnp.asarray(qd))
        (place, rate), velocity = found
        offset = (0.3 - 0.2j) * np.exp(1j * angle)
        expected = starts[link] + [offset.real, offset.imag]
        np.testing.assert_allclose(place, expected, atol=1e-14)
        np.testing.assert_allclose(velocity, rate @ np.array([1, 1j]), atol=1e-14)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
@pytest.mark.parametrize("follows", [False, True])
def test_a_wrench_does_the_power_of_force_and_moment(topology, follows):
    linkage, q, qd = random_motion(topology)
    tip = fj.Point(3, linkage.length[3])
    wrench = fj.Wrench(tip, [3.0, -2.0], 1.5, follows=follows)
    force = (3 - 2j) * np.exp(1j * fj.paper.to_chain(linkage, q, qd)[0][5] * follows)
    exact = np.asarray(fj.tip_jacobian(linkage, q)).T @ [force.real, force.imag, 1.5]
    np.testing.assert_allclose(effort(wrench, q, qd, linkage), exact, atol=1e-13)
    on_ground = wrench.replace(point=fj.Point(0, 1.0))
    np.testing.assert_array_equal(effort(on_ground, q, qd, linkage), 0)
    timed = wrench.replace(**RISING)
    np.testing.assert_allclose(effort(timed, q, qd, linkage, 0.5), exact, atol=1e-13)


@pytest.mark.parametrize("side, sign", [("cable", 1), ("bumper", -1)])
def test_one_sided_springs(side, sign):
    linkage, q, qd = random_motion("RRR")
    of = lambda q: fj.SpringDamper(A, B).length(linkage, q)
    length, rate = jax.jvp(of, (jnp.asarray(q),), (jnp.asarray(qd),))
    for shift in (-0.1, 0.1):
        options = dict(stiffness=30.0, damping=0.1, rest_length=length - shift)
        spring = fj.SpringDamper(A, B, **options)
        one = spring.replace(one_sided=side)
        both, found = (np.asarray(effort(e, q, qd, linkage)) for e in (spring, one))
        assert np.abs(both).max() > 0.1
        works = shift * sign > 0
        np.testing.assert_allclose(found, works * both, rtol=1e-13)
        energy = works * 30.0 * shift**2 / 2
        np.testing.assert_allclose(one.potential_energy(q, linkage), energy, rtol=1e-12)
    # A damper alone would push a slackening cable and hold a leaving bumper back.
    held = one.replace(stiffness=1e-9, damping=9.0, rest_length=length - 0.1 * sign)
    closing = -np.sign(sign * rate) * qd  # of a cable or a bumper at work
    np.testing.assert_array_equal(effort(held, q, closing, linkage), 0)
    assert np.abs(effort(held, q, -closing, linkage)).max() > 1


def test_where_points_meet_or_are_nowhere():
    """Forces and derivatives are finite; a traced link may not be there."""
    linkage, q, qd = random_motion("RRR")
    options = dict(stiffness=3.0, damping=1.0, rest_length=0.5)
    same = fj.SpringDamper(fj.Point(1), fj.Point(1), **options)
    np.testing.assert_array_equal(effort(same, q, qd, linkage), 0)
    assert np.isfinite(jax.jacfwd(lambda q: effort(same, q, qd, linkage))(q)).all()
    away = fj.SpringDamper(A, fj.Point(4, 0.1), stiffness=1)
    assert np.isnan(
        jax.jit(lambda s: s.potential_energy(jnp.asarray(q), linkage))(away)
    )


# Elements with inertia: energies and efforts of their bodies, written out

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
