"""One trace serves all topologies, also with fixed pairs; batches equal single motions.

That plain calls share one program among topologies is in test_programs.py.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

TS = np.linspace(0, 0.5, 6)
# A common start and links for which all topologies reach a small circle.
START = np.array([0.1, 0.7, 0.3, 1.5, 0.2, 2.2])


def linkage_and_state(topology):
    moving = topology.replace("F", "R")
    locked, state = fj.paper.from_chain(moving, START, np.zeros(6), base_angle=0.2)
    linkage = fj.Linkage(
        topology, length=[0.1, 1.0, 0.8, 0.5], mass=[2, 1.5, 1],
        com=[[0.5, 0.1], [0.4, -0.1], [0.25, 0]], inertia=[0.2, 0.1, 0.05],
        locked=locked, base_angle=0.2,
    )  # fmt: skip
    return linkage, state


def circle(linkage, state):
    """Returns a small circle around the tip's start, on the start's assembly."""
    tip = np.asarray(fj.tip_position(linkage, state.q))
    orientation = float(fj.paper.to_chain(linkage, state.q, np.zeros(3))[0][5])
    for branch in (1, -1):
        q = fj.inverse_kinematics(linkage, tip, orientation, branch=branch)
        if np.abs(q - state.q).max() < 1e-9:
            break
    task = fj.CircleTask(tip, 0.05, 1.0, 0.3, orientation, branch)
    return fj.PDController([40.0] * 3, [4.0] * 3, [200.0] * 3, task)


def members(on_circles):
    for topology in fj.TOPOLOGIES if on_circles else (*fj.TOPOLOGIES, "RFR", "FRP"):
        linkage, state = linkage_and_state(topology)
        more = fj.JointDamper([1.0, 2.0, 3.0]), fj.JointEffort([0.5, -1.0, 0.2])
        yield linkage, state, (circle(linkage, state), *more) if on_circles else ()


# Fixed steps: adaptive ones may round differently in a batch.
STEPS = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.005)


@pytest.mark.parametrize("on_circles", [False, True])
def test_one_trace_and_batch_equals_singles(on_circles):
    traces = []

    def motion(linkage, state, forces, solver=LoopedDopri8()):
        traces.append(1)
        return fj.simulate(linkage, state, TS, forces, solver=solver, **STEPS)

    single, scenes = jax.jit(motion), [*members(on_circles)]
    alone = [single(*scene) for scene in scenes]
    assert len(traces) == 1
    # The default solver of batches takes long to compile: once is enough. It takes the
    # same steps.
    options = {} if on_circles else dict(solver=None)
    batched = jax.jit(jax.vmap(functools.partial(motion, **options)))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    together = batched(*stacked)
    reversed_order = batched(*jax.tree.map(lambda a: a[::-1], stacked))
    assert len(traces) == 2
    for i, solution in enumerate(alone):
        for a, b in ((together.q, solution.q), (together.qd, solution.qd)):
            np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(reversed_order.q[::-1], together.q, atol=1e-12)
