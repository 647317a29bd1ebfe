"""Inverse kinematics: poses, the edge of the reach, derivatives, numbers of joints."""

import chains
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj

UNIT = fj.Linkage(
    "RRR", length=[0, 1, 1, 0], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1] * 3
)


@jax.jit
def pose(linkage, q):
    """Returns the tip and the orientation, (3,)."""
    x, _ = fj.paper.to_chain(linkage, q, jnp.zeros_like(q))
    return jnp.append(fj.tip_position(linkage, q), x[-1])


def with_fixed_pairs(moving, rng):
    """Returns five letters, with fixed pairs inserted anywhere."""
    letters = list(moving)
    while len(letters) < 5:
        letters.insert(rng.integers(len(letters) + 1), "F")
    return "".join(letters)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [*fj.TOPOLOGIES, "RR", "RP", "PR", "PP"])
def test_both_branches_reach_the_pose_and_one_is_the_original(moving):
    rng, apart = np.random.default_rng(7), []
    for topology in [moving] * 6 + [with_fixed_pairs(moving, rng) for _ in range(4)]:
        chain, real = chains.random_chain(topology, rng), chains.moving(topology)
        q = np.where(real, rng.normal(size=len(topology)), 0)
        *tip, angle = pose(chain, q)
        distances = []
        for branch in (1, -1):
            oriented = len(moving) == 3
            at = tip, angle if oriented else None
            found = fj.inverse_kinematics(chain, *at, branch=branch)
            np.testing.assert_array_equal(found[~real], 0)
            *reached, turned = pose(chain, found)
            np.testing.assert_allclose(reached, tip, atol=1e-12)
            if oriented:
                np.testing.assert_allclose(turned, angle, atol=1e-12)
            away = np.asarray(found) - q
            turns = np.array([joint == "R" for joint in topology])
            away = np.where(turns, np.angle(np.exp(1j * away)), away)
            distances.append(np.abs(away).max())
        assert min(distances) < 1e-10, topology
        apart.append(max(distances) > 1e-3)
    # Two slides make the solution unique; otherwise the branches are two assemblies.
    assert np.mean(apart) > 0.6 if moving.count("P") < 2 else not any(apart)


@jax.jit
def reached(linkage, target, branch):
    """Returns the joints for a pose, and the derivatives of the pose that they reach.

    One program serves all topologies, whose other branches must not leak NaN.
    """
    at = lambda arm, to: fj.inverse_kinematics(arm, to[:2], to[2], branch=branch)
    slopes = jax.jacrev(lambda *a: pose(a[0], at(*a)), (0, 1))(linkage, target)
    return at(linkage, target), *slopes


@pytest.mark.slow
@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_derivatives_keep_a_pose_and_follow_it(topology):
    rng = np.random.default_rng(6)
    for branch in [1.0, -1.0] * 3:
        linkage, q = random_linkage(topology, rng), rng.uniform(-3, 3, 3)
        _, in_linkage, in_target = reached(linkage, pose(linkage, q), branch)
        for leaf in jax.tree.leaves(in_linkage):
            np.testing.assert_allclose(leaf, np.zeros_like(leaf), atol=1e-8)
        np.testing.assert_allclose(in_target, np.eye(3), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("topology, inside, path", [
    ("RRR", -1, lambda s, a: [s * np.cos(a), s * np.sin(a)]),  # outstretched
    ("RPR", 1, lambda s, a: [s * np.cos(a), s * np.sin(a)]),  # within its offset
    ("PRR", -1, lambda s, a: [s, a]),  # link 3 level
    ("RRP", -1, lambda s, a: [s * np.cos(0.2), s * np.sin(0.2)]),  # along link 2
])  # fmt: skip
def test_the_edge_of_the_reach(topology, inside, path):
    """Beyond it tips are refused or NaN; at it there is no number for a derivative."""
    linkage, edge = UNIT.replace(topology=topology), 2  # the two lengths together
    message = r"^tip: .* within reach .*, got .* beyond it by (1e-06|9.99e-07) m"
    for a in (-2.0, 0.0, 1.0):
        within, at, beyond = (path(edge + by * inside, a) for by in (1e-6, 0, -1e-6))
        for branch in (1, -1):
            for tip in within, at:
                q = fj.inverse_kinematics(linkage, tip, 0.2, branch=branch)
                found = fj.tip_position(linkage, q)
                np.testing.assert_allclose(found, tip, atol=1e-14)
            with pytest.raises(ValueError, match=message):
                fj.inverse_kinematics(linkage, beyond, 0.2, branch=branch)
            rows = [reached(linkage, jnp.array([*tip, 0.2]), float(branch))
                    for tip in (within, at, beyond)]  # fmt: skip
            finite = [[bool(np.isfinite(x).all()) for x in row[::2]] for row in rows]
            assert finite[0] == [True, True] and finite[2] == [False, False]
            assert finite[1][0]
            if a == 0 and topology == "RRR":  # without rounding
                assert not finite[1][1]


def test_a_folded_arm_is_back_at_its_pivot():
    """Links of equal length reach the pivot; beside it, digits might cancel."""
    for away in (0, 1e-16, 1e-12, 1e-8, 1e-4):
        tip = away * np.array([0.6, 0.8])
        q = fj.inverse_kinematics(UNIT, tip, 0.0)
        np.testing.assert_allclose(fj.tip_position(UNIT, q), tip, atol=1e-15)


PARALLEL = "^tip: .*, and two slides that are parallel"
COUNT = "^linkage: expected {} j"


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("topology, locked, orientation, words", [
    ("PPR", [np.pi, 0, 0], 0.2, PARALLEL),
    ("RPP", [0, 0, 0.3], 0.2, PARALLEL),
    ("PRP", [0, 0, 0], 0.3, PARALLEL),  # where the tip keeps the ground's direction
    ("PPP", [0.5, 0.7, 0.3], 0.3, "^linkage: expected a joint that turns"),
    *((name, 0, 0.3, COUNT.format(3)) for name in ("R", "RFP", "FRRFPR")),
    *((name, 0, None, COUNT.format(2)) for name in ("R", "RRR")),
])  # fmt: skip
def test_arms_that_reach_no_given_pose(topology, locked, orientation, words):
    arm = chains.random_chain(topology, np.random.default_rng(9))
    arm = arm.replace(locked=locked, base_angle=0.3)
    with pytest.raises(ValueError, match=words):
        fj.inverse_kinematics(arm, [0.5, 0.7], orientation)
    path, laps = fj.references.Ellipse([0.5, 0.7], [0, 0]), fj.references.Laps(1.0)
    with pytest.raises(ValueError, match=words.removeprefix("^tip: .*")):
        fj.TipTask(path, laps, orientation=orientation).check(arm, np.array([0, 0.1]))
    if len(topology) > 2:  # what a program does not know ends as NaN
        traced = jax.jit(fj.inverse_kinematics)(arm, [0.5, 0.7], orientation)
        assert np.isnan(traced).any()


def test_frames_of_links_lead_to_the_tip():
    rng = np.random.default_rng(1)
    arm, q = random_linkage("RPR", rng), rng.uniform(-1, 1, (3, 3))
    found = fj.linkage.link_frames(arm, q)
    tips = jax.vmap(fj.tip_position, (None, 0))(arm, q) @ np.array([1, 1j])
    np.testing.assert_allclose(found.tip(arm), tips, atol=1e-12)
    with pytest.raises(ValueError, match="^q: expected an array of nx3 real numbers"):
        fj.linkage.link_frames(arm, q[0])
    with pytest.raises(ValueError, match=r"^q: .*jax.vmap.*, got shape \(3, 3\)"):
        fj.tip_position(arm, q)
