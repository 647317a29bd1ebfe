"""One circle that all seven topologies track."""

import functools

import jax
import numpy as np
import pytest

import fdof_jax as fj

SCENES = fj.tuning.circle_scenes()
TS = np.linspace(0, 4, 201)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, 0))
def along(task, linkage, t):
    q, _ = task(t, linkage)
    return q, fj.tip_jacobian(linkage, q), fj.tip_position(linkage, q)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_the_circle_is_reachable_from_where_the_arm_is(topology):
    scene = SCENES[topology]
    task = scene.forces[0].reference
    assert fj.references.reachable(scene.linkage, task, TS).all()
    q, jacobians, tips = map(np.asarray, along(task, scene.linkage, TS))
    # Within reach of the start, without a jump, and away from singularities.
    assert np.abs(q[0] - np.asarray(scene.state0.q)).max() < 0.1
    assert np.abs(np.diff(q, axis=0)).max() < 0.05
    assert np.abs(np.linalg.det(jacobians)).min() > 0.5
    distance = np.linalg.norm(tips - np.asarray(task.center), axis=1)
    np.testing.assert_allclose(distance, 0.25, atol=1e-12)


def test_all_start_alike():
    chains = [fj.to_chain(s.linkage, *s.state0)[0] for s in SCENES.values()]
    np.testing.assert_allclose(chains, np.tile(chains[0], (7, 1)), atol=1e-14)
    tips = [fj.tip_position(s.linkage, s.state0.q) for s in SCENES.values()]
    np.testing.assert_allclose(tips, np.tile(tips[0], (7, 1)), atol=1e-12)
    start = SCENES["RRR"].forces[0].reference.tip(0.0)
    assert 0.04 < np.linalg.norm(np.asarray(start) - np.asarray(tips[0])) < 0.06


def test_reachable_says_when():
    scene = SCENES["RRR"]
    task = fj.CircleTask(
        center=(1.99, 0.95), radius=0.75, period=4.0, orientation=0.8, branch=-1
    )
    found = np.asarray(fj.references.reachable(scene.linkage, task, TS))
    # With known values, and with traced ones within a transformation.
    known = jax.jit(lambda x: x + fj.references.reachable(scene.linkage, task, TS))(0)
    np.testing.assert_array_equal(known, found)
    traced = jax.jit(lambda ts: fj.references.reachable(scene.linkage, task, ts))(TS)
    np.testing.assert_array_equal(traced, found)
    assert found.any() and not found.all()
    for t, there in zip(TS[::25], found[::25]):
        try:
            fj.inverse_kinematics(scene.linkage, task.tip(t), 0.8, branch=-1)
            assert there
        except ValueError:
            assert not there


def test_scenes_that_cannot_be_tuned_together():
    with pytest.raises(ValueError, match="scenes: expected a list"):
        fj.tuning.tune_each(SCENES["RRR"])
    other = SCENES["RRR"]._replace(forces=(*SCENES["RRR"].forces, fj.JointDamper(1.0)))
    with pytest.raises(ValueError, match=r"scenes\[1\]: expected one like scenes\[0\]"):
        fj.tuning.tune_each([SCENES["RRR"], other])
