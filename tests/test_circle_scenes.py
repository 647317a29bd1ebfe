"""One circle that all seven topologies track."""

import functools
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.tuning import search
from fdof_jax.tuning.result import _message

SCENES = fj.scenes.circle_scenes()
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
    chains = [fj.paper.to_chain(s.linkage, *s.state0)[0] for s in SCENES.values()]
    np.testing.assert_allclose(chains, np.tile(chains[0], (7, 1)), atol=1e-14)
    tips = [fj.tip_position(s.linkage, s.state0.q) for s in SCENES.values()]
    np.testing.assert_allclose(tips, np.tile(tips[0], (7, 1)), atol=1e-12)
    start = SCENES["RRR"].forces[0].reference.tip(0.0)
    assert 0.04 < np.linalg.norm(np.asarray(start) - np.asarray(tips[0])) < 0.06


@pytest.mark.slow
def test_reachable_says_when():
    arm = SCENES["RRR"].linkage
    task = SCENES["RRR"].forces[0].reference.replace(radius=0.75)
    found = np.asarray(fj.references.reachable(arm, task, TS))
    assert found.any() and not found.all()
    assembled = lambda t: fj.inverse_kinematics(arm, task.tip(t), 0.8, branch=-1)
    q = np.asarray(jax.vmap(assembled)(TS))
    np.testing.assert_array_equal(np.isfinite(q).all(axis=1), found)


@pytest.mark.slow
def test_one_program_tunes_all_topologies():
    first = fj.tune(SCENES["PPR"])
    compiled = search._evaluate.__wrapped__._cached._cache_size()
    errors = [fj.tune(scene).tip_error for scene in SCENES.values()]
    assert search._evaluate.__wrapped__._cached._cache_size() == compiled
    best = int(np.argmin(errors))
    assert fj.TOPOLOGIES[best] == "PPR" and errors[best] == first.tip_error < 5e-3
    assert max(errors) < 60e-3


def with_fixed(tuned, topology):
    """Returns a result of tuning as of an arm whose other joints are fixed."""
    moves = np.array([kind != "F" for kind in topology])
    scene = tuned.scene._replace(linkage=tuned.scene.linkage.replace(topology=topology))
    history = tuned.history
    arrays = lambda h: (h.gains, h.saturated, h.effort)
    masked = [values * moves for values in arrays(history)]
    parts = lambda r: (r.scene, r.histories[0], r.lower, r.upper)
    changed = eqx.tree_at(arrays, history, masked)
    new = scene, changed, tuned.lower * moves, tuned.upper * moves
    return eqx.tree_at(parts, tuned, new)


def test_fixed_pairs_count_nothing_in_results_of_tuning(tuned):
    assert tuned.effort == pytest.approx(0.5)
    for topology in ("RPF", "RFF", "FPR"):
        result = with_fixed(tuned, topology)
        assert result.effort == pytest.approx(0.5)
        count = 2 * sum(kind != "F" for kind in topology)
        held = result.at_bound.sum()
        assert f"{held} of {count} gains at a bound" in repr(result)
        # A flat start is explained by all actuators that there are.
        saturated = np.array([[kind != "F" for kind in topology]], float)
        history = eqx.tree_at(lambda h: h.saturated, result.history, saturated)
        run: Any = SimpleNamespace(reason="", flat=True)
        text = _message(result.scene, run, history, result._box)
        assert "because every actuator is at its limit throughout" in text


def test_gains_held_by_their_bounds_are_not_counted(tuned):
    lower = tuned.lower.copy()
    lower[1, 0] = tuned.upper[1, 0]
    held = eqx.tree_at(lambda r: r.lower, tuned, lower)
    assert "1 of 5 gains at a bound" in repr(held)
