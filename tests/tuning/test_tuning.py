"""Gain tuning converges within its bounds; no random search beats its result."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.tuning import search
from fdof_jax.tuning.losses import (
    demands,
    gains_of,
    residuals_of,
    tip_errors,
    with_gains,
)

pytestmark = pytest.mark.slow
TASK = scenes.two_link_circle().forces[0].reference
# The arm of its scene, with a fixed pair within the first link
ARM = fj.Linkage(
    "RFR", length=[0, 0.5, 0.5, 0.8], com=[[0.25, 0], [0.25, 0], [0.4, 0]],
    mass=[1, 1, 1], inertia=[1 / 48, 1 / 48, 0.8**2 / 12], gravity=0,
)  # fmt: skip
START = fj.State(fj.inverse_kinematics(ARM, [1.1, 0], None), np.zeros(3))


class Indexed(eqx.Module):
    """An effort on one joint, given by an index, with a table of whole numbers."""

    joint: int
    on: bool
    table: jax.Array

    def __call__(self, t, q, qd, linkage):
        return jnp.zeros(3).at[self.table[self.joint]].set(-5.0 if self.on else 0.0)


def circle(kd=10, limit=(60, 1, 30), t1=2.0, wind=2.0):
    """Returns a scene with all kinds of elements; six starts share one program."""
    push = Indexed(1, True, jnp.array([1, 2]))
    blow = lambda t, q, qd, linkage: [wind, 0, 0]
    return fj.Scene(ARM, START, (fj.PDController(100, kd, limit, TASK), push, blow), t1)


demanded = eqx.filter_jit(demands, **LOOPS)


def made_of(q, qd, t1=2.0):
    """Returns states as a motion; all of them share a program."""
    ts = jnp.linspace(0, t1, len(q))
    return fj.Solution(ts, *map(jnp.asarray, (q, qd)), {}, None)


def losses_of(scene, gains):
    """Returns the mean squared tip error of each row of gains (n, 2, joint)."""
    found = []
    for row in gains:
        trial = with_gains(scene, jnp.asarray(row))
        motion = fj.simulate(trial, np.linspace(0, trial.t1, 1001))
        found.append(np.sum(tip_errors(trial, motion) ** 2))
    return np.array(found)


def test_all_starts_agree_and_no_random_gains_do_better():
    scene = circle()  # Fig 7, from 20 starts, in the benchmarks
    result = fj.tune(scene, factor=10.0, starts=6)
    rms = np.sqrt(result.losses)
    assert rms.shape == (6,) and (rms <= 1.01 * rms.min()).all()
    history = result.history
    assert result.converged and (np.diff(history.loss) < 0).all()
    assert history.gradient_norm[-1] <= 1e-3 * history.gradient_norm[0]
    np.testing.assert_array_equal(gains_of(result.scene), result.gains)
    moving = result.gains[:, [0, 2]] > 0
    assert moving.all() and not result.gains[:, 1].any()
    low, high = (np.where(b > 0, b, 1) for b in (result.lower, result.upper))
    shares = np.random.default_rng(5).uniform(size=(32, 2, 3))
    random = low ** (1 - shares) * high**shares
    (calm,) = losses_of(circle(wind=0.0), result.gains[None])
    *others, tuned = losses_of(scene, np.concatenate([random, result.gains[None]]))
    effort = np.sqrt(np.mean(history.effort[-1, [0, 2]] ** 2))
    assert result.effort == pytest.approx(effort) and "of 4 gains" in repr(result)
    assert tuned == pytest.approx(result.loss, rel=1e-5)
    assert result.tip_error == pytest.approx(tuned**0.5, rel=1e-5)
    assert min(others) > tuned and abs(calm - tuned) > 1e-3 * tuned


def test_another_method_descends_as_far():
    best = fj.tune(circle(), factor=1.2, starts=6, max_steps=8)
    programs = search._evaluate.__wrapped__._cached._cache_size()
    other = fj.tune(circle(), factor=1.2, starts=6, method="l-bfgs", max_steps=8)
    assert search._evaluate.__wrapped__._cached._cache_size() == programs
    start = other.histories[0].loss[0]
    assert start - other.loss > 0.98 * (start - best.loss) > 0


def test_reports_and_texts_say_what_happened():
    scene, lines = circle(limit=[10, 1, 5]), []
    result = fj.tune(scene, starts=6, max_steps=1, report=lines.append)
    assert len(lines) == 2 and all("rms tip error" in line for line in lines)
    text = str(result)
    assert "kp of R1 [N m/rad]" in text and "kd of F2" in text
    assert f"{1e3 * result.tip_error:.5g}" in text
    assert "not converged, 1 iterations: stopped after 1 evaluations (max_st" in text
    assert ("at its bound" in text) == result.at_bound.any()
    motion = fj.simulate(scene, np.linspace(0, scene.t1, 1001))
    motion = made_of(motion.q, motion.qd)
    demand = np.asarray(demanded(scene.forces[0], ARM, motion))
    beyond = np.mean(np.abs(demand) > [10, 1, 5], axis=0)
    assert beyond.any() and beyond[1] == 0
    np.testing.assert_allclose(result.histories[0].saturated[0], beyond, atol=3e-3)


def test_starts_that_fail_are_counted():
    scene = circle(t1=0.2)
    gains = gains_of(scene)  # at most so stiff that the first steps fail
    result = fj.tune(scene, bounds=(gains, gains * 1e100), starts=6, max_steps=1)
    failed = np.isnan(result.losses).sum()
    assert failed and f"{failed} of 6 starts could not be simulated" in str(result)
    assert np.isfinite(result.loss)


def test_gains_of_zero_and_fixed_gains_stay_and_are_not_held():
    scene = circle(kd=[10, 1, 0], t1=0.5)
    gains, room = np.asarray(gains_of(scene)), np.array([[4, 1, 1], [4, 1, 4]])
    bounds = gains / room, gains * room + [[0, 0, 0], [0, 0, 1]]
    result = fj.tune(scene, bounds=bounds, starts=6, max_steps=2)
    assert result.loss < result.histories[0].loss[0]
    np.testing.assert_allclose(result.gains[:, 2], [100, 0])
    assert not result.at_bound[:, 1:].any() and "of 2 gains" in result.message


def test_a_gradient_of_zero_is_not_taken_for_convergence():
    result = fj.tune(circle(limit=1e-6, t1=0.05), factor=1.1, starts=6)
    assert not result.converged
    assert "every actuator is at its limit" in result.message
    assert "R3 is at its limit for 100 % of the time, so its gains" in result.message


def test_prices_are_those_of_the_documentation():
    """Effort and its rate, relative to the limits, beside the mean squared error."""
    scene, rng = circle(limit=[60, 1, 30]), np.random.default_rng(0)
    q, qd = rng.normal(size=(2, 1001, 3))
    motion = made_of(q, qd)
    demand = np.asarray(demanded(scene.forces[0], ARM, motion))
    relative = np.clip(demand / [60, 1, 30], -1, 1)
    assert (np.abs(relative) == 1).any() and not relative[:, 1].any()
    rates = np.diff(relative, axis=0) / 0.002
    expected = float(np.sum(tip_errors(scene, motion) ** 2))
    expected += 0.1 * np.mean(np.sum(relative**2, axis=1))
    expected += 1e-4 * np.mean(np.sum(rates**2, axis=1))
    loss = fj.tuning.Tracking(effort=0.1, effort_rate=1e-4)
    residuals = eqx.filter_jit(loss, **LOOPS)(scene, motion)
    assert float(residuals @ residuals) == pytest.approx(expected, rel=1e-12)
    scalar = lambda scene, motion: 3 * jnp.sum(motion.q**2)  # is the loss itself
    (root,) = residuals_of(scalar, scene, motion)
    assert float(root**2) == pytest.approx(3 * np.sum(q**2), rel=1e-12)
