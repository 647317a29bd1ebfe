"""One method in three solvers: for single arms, for batches, and diffrax's own."""

import chains
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SLIDE

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8
from fdof_jax.steps.unrolled_dopri8 import UnrolledDopri8

pytestmark = pytest.mark.slow
START = fj.State(np.array([0.3]), np.array([0.5]))
TS = np.linspace(0, 0.3, 7)
STEPS = dict(stepsize_controller=diffrax.ConstantStepSize(), max_steps=20_000)


class Pull(eqx.Module):
    stiffness: jax.Array

    def __call__(self, t, q, qd, linkage):
        return -self.stiffness * q


def acting(share=1.0):
    """Returns elements written in scalars and in arrays, one with a state."""
    effort = fj.JointEffort([3.0 * share])
    lag = fj.control.FirstOrderLag(effort, 0.2)
    return fj.JointDamper([0.3 * share]), lag, Pull(jnp.array([0.1 * share]))


# One link, as programs of three take three times as long to compile.
ARM = chains.random_chain("R", np.random.default_rng(2))


def assert_alike(motion, other, **bounds):
    for name in ("q", "qd", "own"):
        rows = [jax.tree.leaves(getattr(m, name)) for m in (motion, other)]
        for a, b in zip(*rows, strict=True):
            np.testing.assert_allclose(a, b, **bounds)


def test_all_take_the_same_steps():
    looped, unrolled, theirs = (
        fj.simulate(ARM, START, TS, acting(), solver=solver, dt0=0.01, **STEPS)
        for solver in (LoopedDopri8(), UnrolledDopri8(), diffrax.Dopri8())
    )
    for motion in (looped, unrolled):
        assert motion.stats["num_steps"] == theirs.stats["num_steps"]
        np.testing.assert_allclose(motion.q, theirs.q, atol=1e-14)
        assert_alike(motion, theirs, atol=1e-13)


@pytest.mark.parametrize("solver", [LoopedDopri8(), UnrolledDopri8()])
def test_a_sum_of_many_steps_loses_no_digit(solver):
    """A free slide; rounding each of 10,000 sums alone would lose two or three.

    Elements of no effect make it the program of the test above.
    """
    scene = SLIDE, fj.State(np.zeros(1), np.array([0.1])), [0, 10], acting(0.0)
    motion = fj.simulate(*scene, solver=solver, dt0=0.001, **STEPS)
    assert abs(motion.q[-1, 0] - 1) < 1e-15


def test_a_batch_moves_as_its_members_across_jumps_and_saturation():
    travel = fj.references.Travel(0.2, begin=0.05)
    task = fj.references.JointMove(START.q, START.q + 0.3, travel)
    forces = (fj.PDController(90.0, 8.0, 9.0, task),)
    move = lambda linkage: fj.simulate(linkage, START, TS, forces)
    linkages = ARM, ARM.replace(topology="P")
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *linkages)
    together = jax.vmap(move)(batch)
    for row, linkage in enumerate(linkages):
        alone = move(linkage)
        member = jax.tree.map(lambda leaf, row=row: leaf[row], together)
        np.testing.assert_allclose(member.q, alone.q, atol=1e-9)
        assert_alike(member, alone, atol=1e-8)
