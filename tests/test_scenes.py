"""A scene is accepted whole in place of its linkage, state and forces."""

from functools import partial

import jax
import numpy as np
import pytest
from elements import SHORT

import fdof_jax as fj

SCENE = fj.scenes.fig3()
ARM, START, FORCES, _ = SCENE
TS = np.linspace(0, 0.05, 6)
OTHER = fj.State(np.array([0.3, 2.0, 0.1]), np.array([0.1, 0.2, 0.3]))
MOTION = fj.Solution(TS, np.full((6, 3), 0.7), np.ones((6, 3)), {}, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "function, whole, parts, options",
    [
        (fj.simulate, (SCENE, TS), (ARM, START, TS, FORCES), SHORT),
        (fj.joint_efforts, (SCENE, MOTION), (ARM, FORCES, MOTION), {}),
        (fj.linearize, (SCENE,), (ARM, START, FORCES), dict(t=0.3)),
        (fj.linearize, (SCENE, OTHER), (ARM, OTHER, FORCES), dict(t=0.3)),
    ],
)
def test_a_scene_stands_for_its_parts(function, whole, parts, options):
    found, expected = function(*whole, **options), function(*parts, **options)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.parametrize(
    "kind, words, call",
    [
        (
            ValueError,
            "^forces: .* Scene",
            lambda: fj.simulate(SCENE, TS, forces=FORCES),
        ),
        (ValueError, "^linkage: .* Scene", lambda: fj.sweep(SCENE, TS, linkage=ARM)),
        (ValueError, "^scene: ", lambda: fj.joint_reactions(SCENE, FORCES, MOTION)),
        (TypeError, "missing .* 'ts'", lambda: fj.simulate(SCENE)),
        (TypeError, "multiple values .* 'ts'", lambda: fj.simulate(SCENE, TS, ts=TS)),
    ],
)
def test_a_scene_beside_its_parts_is_refused(kind, words, call):
    with pytest.raises(kind, match=f"(?s){words}"):
        call()


@jax.jit
@partial(jax.vmap, in_axes=(None, None, 0))
def along(task, arm, t):
    q, _ = task(t, arm)
    return q, fj.tip_jacobian(arm, q)


def test_circle_scenes_begin_alike_beside_a_circle_within_their_reach():
    times, chains = np.linspace(0, 4, 101), []
    for arm, start, (controller,), _ in fj.scenes.circle_scenes().values():
        chains.append(fj.paper.to_chain(arm, *start)[0])
        tip, task = fj.tip_position(arm, start.q), controller.reference
        assert 0.04 < np.linalg.norm(task.tip(0.0) - tip) < 0.06
        # Near the start, and away from singularities
        q, jacobians = along(task, arm, times)
        assert np.abs(q[0] - np.asarray(start.q)).max() < 0.1
        assert np.abs(np.linalg.det(jacobians)).min() > 0.5  # NaN out of reach
    np.testing.assert_allclose(chains, np.tile(chains[0], (7, 1)), atol=1e-14)
