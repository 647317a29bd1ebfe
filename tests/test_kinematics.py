"""Points of the chain, their derivatives, and inverse kinematics."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj
from fdof_jax.mechanics.inverse_kinematics import (
    arm_of,
    known_directions,
    plane_angle,
    solve_joints,
)
from fdof_jax.mechanics.kinematics import mass_center_velocities

SAMPLES = 12

each_topology = pytest.mark.parametrize("topology", fj.TOPOLOGIES)


def stack(linkages):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *linkages)


def samples(topology, seed=0):
    """Returns stacked random linkages of one topology, with random motions."""
    rng = np.random.default_rng(seed)
    linkages = stack([random_linkage(topology, rng) for _ in range(SAMPLES)])
    q, qd = rng.uniform(-3, 3, (2, SAMPLES, 3))
    return linkages, jnp.asarray(q), jnp.asarray(qd)


@jax.jit
def pose(linkage, q):
    """Returns the tip and the orientation, (3,)."""
    x, _ = fj.paper.to_chain(linkage, q, jnp.zeros(3))
    return jnp.append(fj.tip_position(linkage, q), x[5])


def turns(angle):
    """Returns the distance of an angle from the nearest whole number of turns."""
    return np.abs(np.angle(np.exp(1j * np.asarray(angle))))


def joint_distance(topology, q, other):
    """Returns the largest difference of joint positions, angles modulo whole turns."""
    difference = np.asarray(q) - np.asarray(other)
    revolute = np.array([joint == "R" for joint in topology])
    return np.where(revolute, turns(difference), np.abs(difference)).max(axis=-1)


# Forward


@each_topology
def test_points_follow_the_chain_link_by_link(topology):
    rng = np.random.default_rng(5)
    for _ in range(3):
        linkage = random_linkage(topology, rng)
        q = rng.uniform(-3, 3, 3)
        length, com, locked = (
            np.asarray(a) for a in (linkage.length, linkage.com, linkage.locked)
        )
        angle, origin = float(linkage.base_angle), np.zeros(2)
        joints, centers = [], []
        for k, joint in enumerate(topology):
            slide, turn = (locked[k], q[k]) if joint == "R" else (q[k], locked[k])
            along = np.array([np.cos(angle), np.sin(angle)])
            across = np.array([-np.sin(angle), np.cos(angle)])
            # origin_{n+1} = origin_n + A_n e_n + B_n ep_n
            origin = origin + length[k] * along + slide * across
            angle = angle + turn
            along = np.array([np.cos(angle), np.sin(angle)])
            across = np.array([-np.sin(angle), np.cos(angle)])
            joints.append(origin)
            centers.append(origin + com[k, 0] * along + com[k, 1] * across)
        tip = origin + length[3] * along
        np.testing.assert_allclose(fj.joint_positions(linkage, q), joints, atol=1e-14)
        np.testing.assert_allclose(fj.mass_centers(linkage, q), centers, atol=1e-14)
        np.testing.assert_allclose(fj.tip_position(linkage, q), tip, atol=1e-14)


@each_topology
def test_tip_jacobian_is_the_derivative_of_the_pose(topology):
    linkages, q, _ = samples(topology, 1)
    jacobian = jax.vmap(fj.tip_jacobian)(linkages, q)
    derivative = jax.vmap(jax.jacfwd(pose, argnums=1))(linkages, q)
    np.testing.assert_allclose(jacobian, derivative, atol=1e-13)


@each_topology
def test_mass_center_velocities_are_the_rates_of_mass_centers(topology):
    linkages, q, qd = samples(topology, 2)
    velocity, rate = jax.vmap(mass_center_velocities)(linkages, q, qd)

    def positions(linkage, q):
        x, _ = fj.paper.to_chain(linkage, q, jnp.zeros(3))
        return fj.mass_centers(linkage, q), x[1::2]

    rates = jax.vmap(lambda k, q, qd: jax.jvp(lambda q: positions(k, q), (q,), (qd,)))
    _, (expected_velocity, expected_rate) = rates(linkages, q, qd)
    np.testing.assert_allclose(velocity, expected_velocity, atol=1e-13)
    np.testing.assert_allclose(rate, expected_rate, atol=1e-13)


# Inverse


def solution(linkage, target, branch=1):
    return fj.inverse_kinematics(linkage, target[:2], target[2], branch=branch)


@partial(jax.jit, static_argnums=2)
def solutions(linkages, targets, branch):
    return jax.vmap(partial(solution, branch=branch))(linkages, targets)


@partial(jax.jit, static_argnums=2)
def derivatives(linkages, targets, branch):
    """Returns the solutions' derivatives in the poses, and the tip Jacobians there."""

    def one(linkage, target):
        def q(target):
            return solution(linkage, target, branch)

        jacobian = fj.tip_jacobian(linkage, q(target))
        return jax.jacrev(q)(target), jacobian

    return jax.vmap(one)(linkages, targets)


@each_topology
def test_both_branches_reach_the_pose_and_one_is_the_original(topology):
    linkages, q, _ = samples(topology, 3)
    target = jax.vmap(pose)(linkages, q)
    distances = []
    for branch in (1, -1):
        found = solutions(linkages, target, branch)
        reached = jax.vmap(pose)(linkages, found)
        np.testing.assert_allclose(reached[:, :2], target[:, :2], atol=1e-10)
        assert turns(reached[:, 2] - target[:, 2]).max() < 1e-10
        distances.append(joint_distance(topology, found, q))
    distances = np.array(distances)
    assert distances.min(axis=0).max() < 1e-7  # a square root near its zero
    # Two slides make the solution unique; otherwise the branches are two assemblies.
    two = topology.count("P") < 2
    assert (
        (distances.max(axis=0) > 1e-3).mean() > 0.7 if two else distances.max() < 1e-7
    )


@each_topology
@pytest.mark.parametrize("branch", [1, -1])
def test_derivatives_of_inverse_kinematics_invert_the_jacobian(topology, branch):
    linkages, q, _ = samples(topology, 4)
    target = jax.vmap(pose)(linkages, q)
    inverse, jacobian = derivatives(linkages, target, branch)
    identity = np.broadcast_to(np.eye(3), jacobian.shape)
    np.testing.assert_allclose(jacobian @ inverse, identity, atol=1e-8)


def test_gradients_in_the_linkage_leave_a_fixed_pose_fixed():
    # Stacked topologies: the branches of the other topologies must not leak NaN.
    rng = np.random.default_rng(6)
    linkages = stack([random_linkage(t, rng) for t in fj.TOPOLOGIES])
    q = jnp.asarray(rng.uniform(-3, 3, (7, 3)))
    target = jax.vmap(pose)(linkages, q)

    def reached(linkage, target):
        q = solution(linkage, target)
        return jnp.sum(pose(linkage, q) * jnp.array([1.0, 2, 3]))

    gradients = jax.jit(jax.vmap(jax.grad(reached)))(linkages, target)
    for leaf in jax.tree.leaves(gradients):
        np.testing.assert_allclose(leaf, np.zeros_like(leaf), atol=1e-9)


def test_inverse_kinematics_of_the_arm_of_figure_7():
    linkage = fj.scenes.fig7().linkage
    q = fj.inverse_kinematics(linkage, [-5, 2], np.pi / 2)
    np.testing.assert_allclose(q, [np.pi / 2, 2.5, -np.pi / 2], atol=1e-15)


@pytest.mark.parametrize("branch", [1, -1])
@pytest.mark.parametrize(
    "topology, inside, path",
    [
        ("RRR", -1, lambda s: [s * np.cos(1), s * np.sin(1)]),  # arm outstretched
        ("RPR", 1, lambda s: [s * np.cos(1), s * np.sin(1)]),  # within its own offset
        ("PRR", -1, lambda s: [s, 0.3]),  # link 3 level
        (
            "RRP",
            -1,
            lambda s: [s * np.cos(0.2), s * np.sin(0.2)],
        ),  # link 2 along link 3
    ],
)
def test_out_of_reach_is_refused_or_nan(topology, inside, path, branch):
    linkage = fj.Linkage(
        topology, length=[0, 1, 1, 0], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
    )
    edge = 2  # the two lengths together
    traced = jax.jit(
        lambda tip: fj.inverse_kinematics(linkage, tip, 0.2, branch=branch)
    )
    reachable = path(edge + 1e-6 * inside)
    q = fj.inverse_kinematics(linkage, reachable, 0.2, branch=branch)
    np.testing.assert_allclose(fj.tip_position(linkage, q), reachable, atol=1e-12)
    np.testing.assert_allclose(traced(jnp.asarray(reachable)), q, atol=1e-12)
    beyond = path(edge - 1e-6 * inside)
    with pytest.raises(ValueError, match=r"^tip: expected .* within reach .*, got \["):
        fj.inverse_kinematics(linkage, beyond, 0.2, branch=branch)
    assert np.isnan(traced(jnp.asarray(beyond))).any()


@pytest.mark.parametrize("topology", ["RRR", "RRP", "RPR", "PRR"])
def test_poses_at_the_edge_of_the_reach_are_within(topology):
    linkages, q, _ = samples(topology, 7)
    q, targets = at_the_edge(topology, linkages, q)
    found = solutions(linkages, targets, 1)
    reached = jax.vmap(pose)(linkages, found)
    np.testing.assert_allclose(reached[:, :2], targets[:, :2], atol=1e-14)
    np.testing.assert_array_less(joint_distance(topology, found, q), 1e-6)
    arms = [jax.tree.map(lambda leaf, i=i: leaf[i], linkages) for i in range(SAMPLES)]
    known = [solution(arm, target, -1) for arm, target in zip(arms, targets)]
    np.testing.assert_array_less(joint_distance(topology, known, q), 1e-6)


def at_the_edge(topology, linkages, q):
    """Returns positions at which the middle joint makes the arm singular, and poses."""

    def volume(middle):
        jacobian = jax.vmap(fj.tip_jacobian)(linkages, q.at[:, 1].set(middle))
        return np.linalg.det(jacobian)

    if topology[1] == "P":  # linear in the slide
        slope = volume(1.0) - volume(0.0)
        middle = -volume(0.0) / slope
    else:  # a sine of the angle
        middle = np.arctan2(-volume(0.0), volume(np.pi / 2))
    q = q.at[:, 1].set(middle)
    return q, jax.vmap(pose)(linkages, q)


UNIT = fj.Linkage(
    "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
)


def test_no_number_stands_for_a_derivative_at_the_edge_of_the_reach():
    linkages = stack([UNIT] * SAMPLES)
    reach = jnp.linspace(3 - 1e-6, 3 + 1e-6, SAMPLES)
    reach = reach.at[:3].set(jnp.array([3 - 1e-15, 3, 3 + 1e-15]))
    targets = jnp.stack([reach, 0 * reach, 0 * reach], axis=1)
    found = solutions(linkages, targets, 1)
    within = np.array([True] * 3 + [False] * 9) | (reach < 3)
    np.testing.assert_array_equal(np.isfinite(found).all(axis=1), within)
    slopes, _ = derivatives(linkages, targets, 1)
    finite = np.isfinite(slopes).all(axis=(1, 2))
    np.testing.assert_array_equal(finite, reach < 3)


def test_a_folded_arm_is_back_at_its_pivot():
    """Links of equal length reach the pivot; beside it, digits might cancel."""
    for away in (0, 1e-16, 1e-12, 1e-8, 1e-4):
        tip = np.array([1 + 0.6 * away, 0.8 * away])
        q = fj.inverse_kinematics(UNIT, tip, 0.0)
        np.testing.assert_allclose(fj.tip_position(UNIT, q), tip, atol=1e-15)


@pytest.mark.parametrize("base_angle", [0.0, 0.3, np.pi])
@pytest.mark.parametrize("lock", [0.0, np.pi])
@pytest.mark.parametrize("topology", ["PPR", "RPP", "PRP"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_parallel_slides_reach_no_given_point(topology, lock, base_angle):
    linkage = fj.Linkage(
        topology,
        length=[0, 1, 1, 1],
        com=[[0.5, 0]] * 3,
        mass=[1] * 3,
        inertia=[1] * 3,
        locked={"PPR": [lock, 0, 0], "RPP": [0, lock, 0.3], "PRP": [0, 0, 0]}[topology],
        base_angle=base_angle,
    )
    # The slides of PRP are parallel if the tip keeps the direction of the ground.
    orientation = base_angle + lock if topology == "PRP" else 0.2
    with pytest.raises(ValueError, match="^tip: expected .* within reach"):
        fj.inverse_kinematics(linkage, [0.5, 0.7], orientation)


@jax.jit
def wrists_solved(linkage, wrists, orientation, branch):
    arm, _ = arm_of(linkage)
    directions = known_directions(arm, orientation)
    one = lambda w, bearing: solve_joints(arm, directions, w, bearing, branch)
    return jax.vmap(one)(wrists, plane_angle(wrists.imag, wrists.real))


@each_topology
@pytest.mark.parametrize("branch", [1, -1])
def test_numpy_solves_the_joints_as_jax_does(topology, branch):
    rng = np.random.default_rng(7)
    unreached = 0
    for _ in range(4):
        linkage = random_linkage(topology, rng)
        wrists = rng.uniform(-2.5, 2.5, (1000, 2)) @ [1, 1j]
        orientation = rng.uniform(-3, 3)
        known, sides = jax.tree.map(np.asarray, linkage), np.asarray(float(branch))
        bearing = plane_angle(wrists.imag, wrists.real)
        angle = np.asarray(orientation)
        three, _ = arm_of(known)
        directions = known_directions(three, angle)
        q, root = solve_joints(three, directions, wrists, bearing, sides)
        expected, _ = wrists_solved(linkage, wrists, angle, sides)
        assert isinstance(q, np.ndarray) and isinstance(root, np.ndarray)
        # Near the edge of the reach a root enlarges rounding to its square root.
        off_edge = ~(np.abs(root) < 1e-6)
        np.testing.assert_allclose(q[off_edge], expected[off_edge], atol=1e-8)
        unreached += np.isnan(q).any(axis=1).sum()
    assert unreached or topology.count("P") == 2


def test_lists_and_integers_are_accepted():
    linkage = fj.scenes.fig5().linkage
    for function in (fj.joint_positions, fj.mass_centers, fj.tip_position):
        np.testing.assert_array_equal(
            function(linkage, [0, 1, 2]), function(linkage, jnp.array([0.0, 1, 2]))
        )
    tip = fj.inverse_kinematics(linkage, (1, 1), 0)
    np.testing.assert_array_equal(
        tip, fj.inverse_kinematics(linkage, jnp.ones(2), jnp.asarray(0.0))
    )


def test_a_time_axis_is_refused_with_a_hint():
    arm, q = fj.scenes.fig5().linkage, np.zeros((5, 3))
    for call in (fj.tip_position, lambda arm, q: fj.energy(arm, q, q)):
        with pytest.raises(ValueError, match=r"^q: .* shape \(5, 3\); jax.vmap"):
            call(arm, q)
