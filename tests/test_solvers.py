"""One method in three solvers: for single arms, for batches, and diffrax's own."""

import chains
import diffrax
import jax
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8
from fdof_jax.steps.unrolled_dopri8 import UnrolledDopri8

START = fj.State(np.array([0.3]), np.array([0.5]))
# Elements written in scalars and in arrays, one with a state.
FORCES = (
    fj.JointDamper([0.3]),
    fj.control.FirstOrderLag(fj.JointEffort([3.0]), 0.2),
    lambda t, q, qd, linkage: -0.1 * q,
)
TS = np.linspace(0, 0.3, 7)
STEPS = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.01)


def arm(topology):
    """Returns one link, as programs of three take three times as long to compile."""
    return chains.random_chain(topology, np.random.default_rng(2))


@pytest.mark.slow
def test_all_take_the_same_steps():
    looped, unrolled, theirs = (
        fj.simulate(arm("R"), START, TS, FORCES, solver=solver, **STEPS)
        for solver in (LoopedDopri8(), UnrolledDopri8(), diffrax.Dopri8())
    )
    for motion in (looped, unrolled):
        assert motion.stats["num_steps"] == theirs.stats["num_steps"]
        np.testing.assert_allclose(motion.q, theirs.q, atol=1e-14)
        np.testing.assert_allclose(motion.qd, theirs.qd, atol=1e-13)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=1e-13),
            motion.own,
            theirs.own,
        )


@pytest.mark.slow
@pytest.mark.parametrize("solver", [LoopedDopri8(), UnrolledDopri8()])
def test_a_sum_of_many_steps_loses_no_digit(solver):
    """A free slide; rounding each of 10,000 sums alone would lose two or three."""
    slide = fj.Linkage(
        "P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], gravity=0.0
    )
    steps = STEPS | dict(dt0=0.001, max_steps=20_000)
    motion = fj.simulate(slide, fj.State([0.0], [0.1]), [0, 10], solver=solver, **steps)
    assert abs(motion.q[-1, 0] - 1) < 1e-15


@pytest.mark.slow
def test_a_batch_moves_as_its_members_across_jumps_and_saturation():
    task = fj.references.JointMove(
        START.q, START.q + 0.3, fj.references.Travel(0.2, begin=0.05)
    )
    lag = fj.control.FirstOrderLag(fj.JointEffort([3.0]), 0.2)
    forces = fj.PDController(90.0, 8.0, 9.0, task), fj.JointDamper(0.3), lag
    linkages = [arm(topology) for topology in ("R", "P")]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *linkages)
    together = jax.vmap(lambda linkage: fj.simulate(linkage, START, TS, forces))(batch)
    for row, linkage in enumerate(linkages):
        alone = fj.simulate(linkage, START, TS, forces)
        np.testing.assert_allclose(together.q[row], alone.q, atol=1e-9)
        own = jax.tree.map(lambda leaf, row=row: leaf[row], together.own)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=1e-8), own, alone.own
        )
