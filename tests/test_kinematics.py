"""Inverse kinematics, and tasks of arms of two joints and with fixed pairs."""

import itertools
from functools import partial

import chains
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT
from helpers import random_linkage

import fdof_jax as fj

SAMPLES = 12
TS = np.linspace(0, 0.2, 5)
WORDS = "^linkage: expected {} joints that move.*, the others fixed, got {}"
UNIT = fj.Linkage(
    "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
)


def stack(linkages):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *linkages)


def samples(topology, seed=0):
    """Returns stacked random linkages of one topology, and random positions."""
    rng = np.random.default_rng(seed)
    linkages = stack([random_linkage(topology, rng) for _ in range(SAMPLES)])
    return linkages, jnp.asarray(rng.uniform(-3, 3, (SAMPLES, 3)))


@jax.jit
def pose(linkage, q):
    """Returns the tip and the orientation, (3,)."""
    x, _ = fj.paper.to_chain(linkage, q, jnp.zeros_like(q))
    return jnp.append(fj.tip_position(linkage, q), x[-1])


def joint_distance(topology, q, other):
    """Returns the largest difference of joint positions, angles modulo whole turns."""
    difference = np.asarray(q) - np.asarray(other)
    turned = np.abs(np.angle(np.exp(1j * difference)))
    revolute = np.array([joint == "R" for joint in topology])
    return np.where(revolute, turned, np.abs(difference)).max(axis=-1)


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


def with_fixed_pairs(moving, rng):
    """Returns the letters with fixed pairs inserted anywhere."""
    letters = list(moving)
    for _ in range(rng.integers(1, 4)):
        letters.insert(rng.integers(len(letters) + 1), "F")
    return "".join(letters)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [*fj.TOPOLOGIES, "RR", "RP", "PR", "PP"])
def test_both_branches_reach_the_pose_and_one_is_the_original(moving):
    rng = np.random.default_rng(7)
    names = [moving] * 8 + [with_fixed_pairs(moving, rng) for _ in range(4)]
    apart = []
    for topology in names:
        chain, real = chains.random_chain(topology, rng), chains.moving(topology)
        q = np.where(real, rng.normal(size=len(topology)), 0)
        *tip, angle = pose(chain, q)
        angle = angle if len(moving) == 3 else None
        distances = []
        for branch in (1, -1):
            found = fj.inverse_kinematics(chain, tip, angle, branch=branch)
            np.testing.assert_allclose(fj.tip_position(chain, found), tip, atol=1e-12)
            np.testing.assert_array_equal(found[~real], 0)
            if angle is not None:
                assert float(pose(chain, found)[2]) == pytest.approx(
                    float(angle), abs=1e-12
                )
            distances.append(joint_distance(topology, found, q))
        assert min(distances) < 1e-10, topology
        apart.append(max(distances) > 1e-3)
    # Two slides make the solution unique; otherwise the branches are two assemblies.
    assert np.mean(apart) > 0.7 if moving.count("P") < 2 else not any(apart)


@pytest.mark.slow
@pytest.mark.parametrize("branch", [1, -1])
def test_derivatives_of_inverse_kinematics_invert_the_jacobian(branch):
    for topology in fj.TOPOLOGIES:
        linkages, q = samples(topology, 4)
        target = jax.vmap(pose)(linkages, q)
        inverse, jacobian = derivatives(linkages, target, branch)
        identity = np.broadcast_to(np.eye(3), jacobian.shape)
        np.testing.assert_allclose(jacobian @ inverse, identity, atol=1e-8)


@pytest.mark.slow
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


@pytest.mark.parametrize(
    "topology, inside, path",
    [
        ("RRR", -1, lambda s: [s * np.cos(1), s * np.sin(1)]),  # arm outstretched
        ("RPR", 1, lambda s: [s * np.cos(1), s * np.sin(1)]),  # within its own offset
        ("PRR", -1, lambda s: [s, 0.3]),  # link 3 level
        ("RRP", -1, lambda s: [s * np.cos(0.2), s * np.sin(0.2)]),  # link 2 along it
    ],
)
def test_out_of_reach_is_refused_or_nan(topology, inside, path):
    linkage = UNIT.replace(topology=topology, length=[0, 1, 1, 0])
    edge = 2  # the two lengths together
    within, beyond = path(edge + 1e-6 * inside), path(edge - 1e-6 * inside)
    for branch in (1, -1):
        q = fj.inverse_kinematics(linkage, within, 0.2, branch=branch)
        np.testing.assert_allclose(fj.tip_position(linkage, q), within, atol=1e-12)
        targets = jnp.array([[*within, 0.2], [*beyond, 0.2]])
        traced, unreached = solutions(stack([linkage] * 2), targets, branch)
        np.testing.assert_allclose(traced, q, atol=1e-12)
        with pytest.raises(ValueError, match=r"^tip: .* within reach .*, got \["):
            fj.inverse_kinematics(linkage, beyond, 0.2, branch=branch)
        assert np.isnan(unreached).any()


@pytest.mark.parametrize("topology", ["RRR", "RRP", "RPR", "PRR"])
def test_messages_say_how_far_a_tip_is_out_of_reach(topology):
    """No tip much nearer than that is within reach, and one hardly farther is."""
    ways = np.exp(1j * np.linspace(0, 2 * np.pi, 128, endpoint=False))
    far, tried = 0, np.random.default_rng(3).uniform(-4, 4, (8, 2))
    linkages, _ = samples(topology, 8)
    for index, tip in enumerate([*tried, *(tried / 10)]):
        linkage = jax.tree.map(lambda leaf, i=index % SAMPLES: leaf[i], linkages)
        try:
            fj.inverse_kinematics(linkage, tip, 0.3)
        except ValueError as error:
            distance = float(str(error).split("beyond it by ")[1].split()[0])
        else:
            continue
        far += 1
        for share, some in (0.99, False), (1.01, True):
            around = tip + share * distance * np.stack([ways.real, ways.imag], axis=1)
            assert reach_any(linkage, around) == some
    assert far > 2


@jax.jit
def reach_any(linkage, tips):
    found = jax.vmap(lambda tip: fj.inverse_kinematics(linkage, tip, 0.3))(tips)
    return jnp.isfinite(found).all(axis=1).any()


@pytest.mark.parametrize("topology", ["RRR", "RRP", "RPR", "PRR"])
def test_poses_at_the_edge_of_the_reach_are_within(topology):
    linkages, q = samples(topology, 7)
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


@pytest.mark.parametrize("topology", ["PPR", "RPP", "PRP"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_parallel_slides_reach_no_given_point(topology):
    for base_angle, lock in itertools.product((0.0, 0.3, np.pi), (0.0, np.pi)):
        locked = {"PPR": [lock, 0, 0], "RPP": [0, lock, 0.3], "PRP": [0, 0, 0]}
        linkage = UNIT.replace(
            topology=topology, locked=locked[topology], base_angle=base_angle
        )
        # The slides of PRP are parallel if the tip keeps the direction of the ground.
        orientation = base_angle + lock if topology == "PRP" else 0.2
        said = "^tip: expected .* within reach.*, and two slides that are parallel"
        with pytest.raises(ValueError, match=said):
            fj.inverse_kinematics(linkage, [0.5, 0.7], orientation)


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
        with pytest.raises(ValueError, match=r"^q: .*jax.vmap.*, got shape \(5, 3\)"):
            call(arm, q)


# Fewer joints than three, and fixed pairs


@pytest.mark.parametrize("topology", ["RR", "FRFRF"])
def test_straight_arms_of_two_joints_reach_their_tip(topology):
    rng, n = np.random.default_rng(12), len(topology)
    first = topology.index("R")
    for angle in rng.uniform(-3, 3, 20):
        chain = chains.random_chain(topology, rng).replace(locked=np.zeros(n))
        q = np.where(np.arange(n) == first, angle, 0)
        tip = fj.tip_position(chain, q)
        found = fj.inverse_kinematics(chain, tip, None)
        np.testing.assert_allclose(fj.tip_position(chain, found), tip, atol=1e-14)


OTHER_NUMBERS = [  # of joints than a tip takes with an orientation, or without one
    ("R", 0.3), ("RFP", 0.3), ("RRRR", 0.3), ("FRRFPR", 0.3),
    ("R", None), ("RRR", None), ("RRRR", None), ("FRRFPR", None),
]  # fmt: skip
CIRCLE = fj.references.Ellipse([0.5, 0.5], [0.1, 0.1])


@pytest.mark.slow
def test_slides_alone_orient_nothing():
    arm = fj.Linkage(
        "PPP", length=[0, 1, 1, 1], com=np.zeros((3, 2)), mass=1 + np.zeros(3),
        inertia=np.zeros(3), locked=[0.5, 0.7, 0.3],
    )  # fmt: skip
    with pytest.raises(ValueError, match="^linkage: expected a joint that turns"):
        fj.inverse_kinematics(arm, [1, 1], 0.3)
    traced = jax.jit(lambda arm: fj.inverse_kinematics(arm, [1, 1], 0.3))
    assert np.isnan(traced(arm)).all()


@pytest.mark.parametrize("topology, orientation", OTHER_NUMBERS)
def test_chains_of_other_numbers_of_joints_are_refused(topology, orientation):
    wanted, count = 2 if orientation is None else 3, len(topology.replace("F", ""))
    chain = chains.random_chain(topology, np.random.default_rng(9))
    with pytest.raises(ValueError, match=WORDS.format(wanted, count)):
        fj.inverse_kinematics(chain, [0.5, 0.5], orientation)
    if len(topology) >= wanted:  # what a program does not know ends as NaN
        found = jax.jit(fj.inverse_kinematics)(chain, [0.5, 0.5], orientation)
        assert np.isnan(found).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, topology, wanted",
    [
        (fj.TipTask(CIRCLE, fj.references.Laps(1.0), orientation=0.3), "RFP", 3),
        (fj.TipTask(CIRCLE, fj.references.Laps(1.0), orientation=None), "RRP", 2),
        (fj.CircleTask([0.5, 0.5], 0.1), "R", 3),
    ],
)
def test_tasks_for_other_numbers_of_joints_are_refused(task, topology, wanted):
    n, count = len(topology), len(topology.replace("F", ""))
    chain = chains.random_chain(topology, np.random.default_rng(9))
    pd = fj.PDController(10.0, 1.0, 50.0, task)
    with pytest.raises(ValueError, match=WORDS.format(wanted, count)):
        fj.simulate(chain, fj.State(np.zeros(n), np.zeros(n)), [0, 0.1], (pd,))


@eqx.filter_jit  # one program for arms of as many pairs
def along(task, chain, t):
    """Returns joints, errors of their rates, and errors of the tip and its velocity."""
    q, qd = task(t, chain)
    _, rate = jax.jvp(lambda t: task(t, chain)[0], (t,), (1.0,))
    tip = lambda q: fj.tip_position(chain, q)
    _, commanded = jax.jvp(task.tip, (t,), (1.0,))
    moved = jax.jvp(tip, (q,), (qd,))[1]
    return q, qd - rate, tip(q) - task.tip(t), moved - commanded


@pytest.mark.slow
@pytest.mark.parametrize("topology", ["RR", "RP", "PR", "RFP"])
def test_tasks_without_orientation_are_followed_at_their_exact_rates(topology):
    chain = chains.random_chain(topology, np.random.default_rng(10))
    chain = chain.replace(length=np.linspace(0.4, 1, len(topology) + 1))
    middle = fj.tip_position(chain, np.full(len(topology), 1.5))
    path = fj.references.Ellipse(middle, [0.02, 0.01])
    task = fj.TipTask(path, fj.references.Laps(2.0), orientation=None)
    for t in jnp.array([0.1, 0.9]):
        q, *differences = along(task, chain, t)
        assert np.isfinite(q).all()
        for difference in differences:
            np.testing.assert_allclose(difference, 0, atol=1e-12)
        h = 1e-4
        slope = (along(task, chain, t + h)[0] - along(task, chain, t - h)[0]) / (2 * h)
        np.testing.assert_allclose(task(t, chain)[1], slope, atol=1e-5)
    # From there, a controller keeps the tip on the path.
    start = fj.State(*task(0.0, chain))
    pd = fj.control.ComputedTorque(400.0, 40.0, np.inf, task)
    motion = fj.simulate(chain, start, TS, (pd,), **SHORT)
    for t, q in zip(motion.ts, motion.q):
        np.testing.assert_allclose(fj.tip_position(chain, q), task.tip(t), atol=1e-4)


def test_frames_of_links_lead_to_the_tip():
    rng = np.random.default_rng(1)
    arm, q = random_linkage("RPR", rng), rng.uniform(-1, 1, (3, 3))
    found = fj.linkage.link_frames(arm, q)
    tips = jax.vmap(fj.tip_position, (None, 0))(arm, q) @ np.array([1, 1j])
    np.testing.assert_allclose(found.tip(arm), tips, atol=1e-12)
    with pytest.raises(ValueError, match="^q: expected an array of nx3 real numbers"):
        fj.linkage.link_frames(arm, q[0])
    with pytest.raises(ValueError, match="^q: expected known values"):
        jax.jit(lambda q: fj.linkage.link_frames(arm, q).angle)(q)


def test_questions_about_an_arm_name_what_is_none():
    for ask in fj.linkage.joint_names, fj.linkage.moving_joints:
        with pytest.raises(ValueError, match="^linkage: expected a Linkage, got"):
            ask("RPR")
