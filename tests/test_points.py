"""Springs, forces and wrenches at points of links: places, loads, times and sides.

Their energies are tested with those of all elements, in test_elements.py, and springs
against MuJoCo's in test_mjcf.py.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_linkage, random_motion

import fdof_jax as fj
from fdof_jax.linkage.frames import scalar_frames

A, B = fj.Point(0, 0.3, -0.4), fj.Point(3, 0.5, 0.2)


# A force and a moment that rise, to those of the test at 0.5 s.
RISING = dict(force=lambda t: jnp.stack([6 * t, -4 * t]), moment=lambda t: 3 * t)

# One program for each kind of element, instead of one for each operation.


@eqx.filter_jit
def position(point, linkage, q):
    return point.position(linkage, q)


@eqx.filter_jit
def effort(element, q, qd, linkage, t=0.0):
    return element(t, q, qd, linkage)


@eqx.filter_jit
def length_and_rate(element, q, qd, linkage):
    return jax.jvp(lambda q: element.length(linkage, q), (q,), (qd,))


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
@pytest.mark.parametrize("link", range(4))
def test_a_point_lies_where_the_links_are(topology, link):
    linkage, q, _ = random_motion(topology)
    point = fj.Point(link, 0.3, -0.2)
    x, _ = fj.paper.to_chain(linkage, q, np.zeros(3))
    angle = [linkage.base_angle, *x[1::2]][link]
    start = [np.zeros(2), *fj.joint_positions(linkage, q)][link]
    along = np.array([np.cos(angle), np.sin(angle)])
    expected = start + 0.3 * along - 0.2 * np.array([-along[1], along[0]])
    np.testing.assert_allclose(position(point, linkage, q), expected, atol=1e-14)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
@pytest.mark.parametrize("follows", [False, True])
def test_a_wrench_does_the_power_of_force_and_moment(topology, follows):
    linkage, q, qd = random_motion(topology)
    tip = fj.Point(3, linkage.length[3])
    wrench = fj.Wrench(tip, [3.0, -2.0], 1.5, follows=follows)
    force = np.array([3.0, -2.0])
    if follows:
        angle = fj.paper.to_chain(linkage, q, qd)[0][5]
        turn = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        force = np.array(turn) @ force
    exact = np.asarray(fj.tip_jacobian(linkage, q)).T @ [*force, 1.5]
    np.testing.assert_allclose(effort(wrench, q, qd, linkage), exact, atol=1e-13)
    on_ground = wrench.replace(point=fj.Point(0, 1.0))
    np.testing.assert_array_equal(effort(on_ground, q, qd, linkage), 0)
    timed = wrench.replace(**RISING)
    np.testing.assert_allclose(effort(timed, q, qd, linkage, 0.5), exact, atol=1e-13)


class Pulse(eqx.Module):
    """A force for 20 ms that declares its times."""

    @property
    def jump_ts(self):
        return jnp.array([3.0, 3.02])

    def __call__(self, t):
        return jnp.where((t >= 3.0) & (t < 3.02), 100.0, 0.0) * jnp.array([1.0, 0.0])


@pytest.mark.slow
def test_a_pulse_that_says_when_is_not_stepped_over():
    arm = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[0.1] * 3
    )
    hanging = fj.State(np.array([-np.pi / 2, 0, 0]), np.zeros(3))
    forces = (fj.Wrench(fj.Point(3, 1.0), Pulse()),)
    end = fj.simulate(arm, hanging, [0, 5], forces)
    assert np.abs(end.qd[-1]).max() > 0.1
    kinetic, potential = fj.energy(arm, end.q[-1], end.qd[-1])
    after = fj.simulate(arm, hanging, [0, 3.02], forces)
    begin = sum(fj.energy(arm, after.q[-1], after.qd[-1]))
    np.testing.assert_allclose(kinetic + potential, begin, rtol=1e-8)


@pytest.mark.parametrize("side, sign", [("cable", 1), ("bumper", -1)])
def test_one_sided_springs(side, sign):
    linkage, q, qd = random_motion("RRR")
    length, _ = length_and_rate(fj.SpringDamper(A, B), q, qd, linkage)
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
    held = fj.SpringDamper(
        A, B, damping=9.0, stiffness=1e-9, rest_length=length - 0.1 * sign,
        one_sided=side,
    )  # fmt: skip
    _, rate = length_and_rate(held, q, qd, linkage)
    closing = -np.sign(sign * rate) * qd  # of a cable or a bumper at work
    np.testing.assert_array_equal(effort(held, q, closing, linkage), 0)
    assert np.abs(effort(held, q, -closing, linkage)).max() > 1


def test_where_points_meet_forces_and_derivatives_are_finite():
    linkage = random_linkage("RRR", np.random.default_rng(1))
    same = fj.SpringDamper(
        fj.Point(1), fj.Point(1), stiffness=3.0, damping=1.0, rest_length=0.5
    )
    q, qd = np.array([0.1, 0.2, 0.3]), np.ones(3)
    np.testing.assert_array_equal(effort(same, q, qd, linkage), 0)
    slope = jax.jacfwd(lambda q: effort(same, q, qd, linkage))(q)
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_velocities_of_points_are_derivatives_of_their_positions(topology):
    arm = random_linkage(topology, np.random.default_rng(1))
    q, qd = jnp.array([0.3, 1.2, -0.4]), jnp.array([0.5, -0.3, 0.7])
    point = fj.Point(3, 0.7, 0.2)
    velocity = point.velocity(scalar_frames(arm, tuple(q)), tuple(qd))
    _, expected = jax.jvp(lambda q: point.position(arm, q), (q,), (qd,))
    np.testing.assert_allclose([velocity.real, velocity.imag], expected, rtol=1e-12)
