"""Inverse kinematics, paths and circles of arms of two joints and with fixed pairs."""

import chains
import jax
import numpy as np
import pytest
from elements import SHORT

import fdof_jax as fj

TS = np.linspace(0, 0.2, 5)
slow = lambda topology: pytest.param(topology, marks=pytest.mark.slow)
WORDS = "^linkage: expected {} joints that move.*, the others fixed, got {}"


def with_fixed_pairs(moving, rng):
    """Returns the letters with fixed pairs inserted anywhere."""
    letters = list(moving)
    for _ in range(rng.integers(1, 4)):
        letters.insert(rng.integers(len(letters) + 1), "F")
    return "".join(letters)


def reached(topology, rng, orientation):
    """Checks that on a branch the chain is back where its tip was put from."""
    chain = chains.random_chain(topology, rng)
    q = np.where(chains.moving(topology), rng.normal(size=len(topology)), 0)
    tip = fj.tip_position(chain, q)
    angle = None
    turns = np.array([joint == "R" for joint in topology])
    if orientation:
        fixed = np.where(turns, q, chain.locked)
        angle = float(chain.base_angle + fixed.sum())
    distances = []
    for branch in (1, -1):
        found = np.asarray(fj.inverse_kinematics(chain, tip, angle, branch=branch))
        np.testing.assert_allclose(fj.tip_position(chain, found), tip, atol=1e-12)
        np.testing.assert_array_equal(found[~chains.moving(topology)], 0)
        if orientation:
            assert (found - q)[turns].sum() == pytest.approx(0, abs=1e-12)
        away = np.where(turns, (found - q + np.pi) % (2 * np.pi) - np.pi, found - q)
        distances.append(np.abs(away).max())
    assert min(distances) < 1e-10, topology


@pytest.mark.parametrize("moving", fj.TOPOLOGIES)
def test_chains_of_three_joints_and_fixed_pairs_reach_a_tip(moving):
    rng = np.random.default_rng(7)
    for _ in range(4):
        reached(with_fixed_pairs(moving, rng), rng, orientation=True)


@pytest.mark.parametrize("moving", ["RR", "RP", "PR", "PP"])
def test_arms_of_two_joints_reach_a_tip(moving):
    rng = np.random.default_rng(8)
    reached(moving, rng, orientation=False)
    for _ in range(3):
        reached(with_fixed_pairs(moving, rng), rng, orientation=False)


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


@pytest.mark.parametrize("orientation, wanted", [(0.3, 3), (None, 2)])
@pytest.mark.parametrize("topology", ["R", "RFP", "RRR", "RRRR", "FRRFPR"])
def test_chains_of_other_numbers_of_joints_are_refused(topology, orientation, wanted):
    count = len(topology.replace("F", ""))
    if count == wanted:
        return
    n = len(topology)
    chain = chains.random_chain(topology, np.random.default_rng(9))
    words = WORDS.format(wanted, count)
    with pytest.raises(ValueError, match=words):
        fj.inverse_kinematics(chain, [0.5, 0.5], orientation)
    if n >= wanted:  # what a program does not know ends as NaN
        found = jax.jit(fj.inverse_kinematics)(chain, [0.5, 0.5], orientation)
        assert np.isnan(found).all()
    circle = fj.references.Ellipse([0.5, 0.5], [0.1, 0.1])
    laps = fj.references.Laps(1.0)
    tasks = [fj.TipTask(circle, laps, orientation=orientation)]
    tasks += [fj.CircleTask([0.5, 0.5], 0.1)] * (wanted == 3)
    for task in tasks:
        pd = fj.PDController(10.0, 1.0, 50.0, task)
        with pytest.raises(ValueError, match=words):
            fj.simulate(chain, fj.State(np.zeros(n), np.zeros(n)), [0, 0.1], (pd,))


@pytest.mark.parametrize("topology", ["RR", "RP", "PR", slow("RFP")])
def test_tasks_without_orientation_are_followed_at_their_exact_rates(topology):
    chain = chains.random_chain(topology, np.random.default_rng(10))
    chain = chain.replace(length=np.linspace(0.4, 1, len(topology) + 1))
    middle = fj.tip_position(chain, np.full(len(topology), 1.5))
    path = fj.references.Ellipse(middle, [0.02, 0.01])
    task = fj.TipTask(path, fj.references.Laps(2.0), orientation=None)

    @jax.jit
    def along(t):
        q, qd = task(t, chain)
        _, rate = jax.jvp(lambda t: task(t, chain)[0], (t,), (1.0,))
        tip = lambda q: fj.tip_position(chain, q)
        _, commanded = jax.jvp(task.tip, (t,), (1.0,))
        return (
            q,
            qd - rate,
            tip(q) - task.tip(t),
            jax.jvp(tip, (q,), (qd,))[1] - commanded,
        )

    for t in (0.1, 0.9):
        q, *differences = along(t)
        assert np.isfinite(q).all()
        for difference in differences:
            np.testing.assert_allclose(difference, 0, atol=1e-12)
        h = 1e-4
        slope = (along(t + h)[0] - along(t - h)[0]) / (2 * h)
        np.testing.assert_allclose(task(t, chain)[1], slope, atol=1e-5)
    # From there, a controller keeps the tip on the path.
    start = fj.State(*task(0.0, chain))
    pd = fj.control.ComputedTorque(400.0, 40.0, np.inf, task)
    motion = fj.simulate(chain, start, TS, (pd,), **SHORT)
    for t, q in zip(motion.ts, motion.q):
        np.testing.assert_allclose(fj.tip_position(chain, q), task.tip(t), atol=1e-4)


@pytest.mark.slow
def test_circles_of_three_joints_and_fixed_pairs():
    topology = "RFRR"
    chain = chains.random_chain(topology, np.random.default_rng(11))
    q = np.where(chains.moving(topology), 0.5, 0)
    turns = np.array([joint == "R" for joint in topology])
    angle = float(chain.base_angle + np.where(turns, q, chain.locked).sum())
    middle = fj.tip_position(chain, q)
    for branch in (1, -1):
        found = fj.inverse_kinematics(chain, middle, angle, branch=branch)
        if np.abs(found - q).max() < 1e-9:
            break
    circle = fj.CircleTask(middle, 0.01, 1.0, 0.3, angle, branch)
    pd = fj.control.ComputedTorque(400.0, 40.0, np.inf, circle)
    start = fj.State(*circle(0.0, chain))
    motion = fj.simulate(chain, start, TS, (pd,), **SHORT)
    for t, q in zip(motion.ts, motion.q):
        np.testing.assert_allclose(fj.tip_position(chain, q), circle.tip(t), atol=1e-4)
    beyond = fj.PDController(1.0, 1.0, 1.0, fj.CircleTask([50, 50], 0.1))
    with pytest.raises(ValueError, match="reference: expected a circle within"):
        fj.simulate(chain, start, [0, 0.1], (beyond,))
