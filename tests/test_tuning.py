"""Gain tuning converges within its bounds; no random search beats its result."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.tuning import search
from fdof_jax.tuning.losses import (
    bounds_of,
    controller_of,
    demands,
    gains_of,
    tip_errors,
    with_controller,
    with_gains,
)


def losses_of(scene, gains):
    """Returns the mean squared tip error of each row of gains (n, 2, 3)."""
    return np.array([np.sum(residuals_of(scene, row) ** 2) for row in gains])


@eqx.filter_jit
def judged(loss, scene, solution):
    return loss(scene, solution)


def residuals_of(scene, gains, loss=tip_errors):
    """Returns residuals of a plain simulation, whose program is shared."""
    trial = with_gains(scene, jnp.asarray(gains))
    solution = fj.simulate(trial, np.linspace(0, trial.t1, 1001))
    # The time is the solution's.
    return np.asarray(judged(loss, trial._replace(t1=0.0), solution))


def with_changes(scene, **fields):
    """Returns a scene with other fields of its controller."""
    return with_controller(scene, scene.forces[0].replace(**fields))


@pytest.mark.slow
def test_all_starts_agree_and_no_random_gains_do_better():
    scene = scenes.two_link_circle()  # Fig 7, from 20 starts, in the benchmarks
    result = fj.tune(scene, factor=10.0, starts=6)
    rms = np.sqrt(result.losses)
    assert rms.shape == (6,) and (rms <= 1.01 * rms.min()).all()
    assert result.converged
    low, high = np.log(result.lower), np.log(result.upper)
    random = np.exp(np.random.default_rng(5).uniform(low, high, (32, 2, 2)))
    *others, tuned = losses_of(scene, np.concatenate([random, result.gains[None]]))
    assert tuned == pytest.approx(result.loss, rel=1e-5)
    assert min(others) > tuned


@pytest.mark.slow
def test_tuning_goes_down_to_a_point_where_only_bounds_hold():
    scene = scenes.fig7()._replace(t1=2.0)
    result = fj.tune(scene)
    history = result.history
    assert result.converged
    assert (np.diff(history.loss) < 0).all()
    assert result.loss == history.loss[-1]
    assert history.gradient_norm[-1] <= 1e-3 * history.gradient_norm[0]
    tuned = controller_of(result.scene)
    np.testing.assert_array_equal([tuned.kp, tuned.kd], result.gains)
    assert "gains are at a bound" in result.message
    # The loss and the tip error equal those of a separate simulation.
    loss = losses_of(scene, result.gains[None])[0]
    assert result.loss == pytest.approx(loss, rel=1e-6)
    assert result.tip_error == pytest.approx(loss**0.5, rel=1e-6)


@pytest.mark.slow
def test_another_method_descends():
    scene = scenes.fig7()._replace(t1=1.0)
    result = fj.tune(scene, factor=1.2, method="l-bfgs", max_steps=8)
    assert result.loss == result.history.loss.min() < result.history.loss[0]
    best = fj.tune(scene, factor=1.2).loss
    start = result.history.loss[0]
    assert start - result.loss > 0.98 * (start - best)


@pytest.mark.slow
def test_history_report_and_text_say_what_happened_and_a_second_call_compiles_nothing():
    scene, lines = scenes.fig7()._replace(t1=1.0), []
    result = fj.tune(scene, max_steps=2, report=lines.append)
    assert len(lines) == 3 and all("rms tip error" in line for line in lines)
    text = str(result)
    assert "kp of R1 [N m/rad]" in text and "kd of P2 [N s/m]" in text
    assert f"{1e3 * result.tip_error:.5g}" in text
    assert "not converged, 2 iterations: stopped after 2 evaluations (max_st" in text
    assert ("at its bound" in text) == result.at_bound.any()
    history, n = result.history, len(result.history.loss)
    assert history.gains.shape == (n, 2, 3)
    assert history.saturated.shape == history.effort.shape == (n, 3)
    assert (np.diff(history.wall_time) > 0).all()
    # The slide's actuator starts saturated, the others never are.
    motion = fj.simulate(scene, np.linspace(0, scene.t1, 1001))
    demand = eqx.filter_jit(demands)(scene.forces[0], scene.linkage, motion)[:, 1]
    beyond = float(np.mean(np.abs(demand) > scene.forces[0].limit[1]))
    assert 0 < history.saturated[0, 1] == pytest.approx(beyond, abs=3e-3)
    assert (history.saturated[0, [0, 2]] == 0).all()
    compiled = search._evaluate.__wrapped__._cached._cache_size()
    task = fj.CircleTask(center=(-3.9, 2.1), radius=0.6)
    trial = with_changes(scene, kp=1.1 * scene.forces[0].kp, reference=task)
    fj.tune(trial._replace(t1=0.9), factor=3.0, max_steps=1, method="l-bfgs")
    assert search._evaluate.__wrapped__._cached._cache_size() == compiled


@pytest.mark.slow
def test_starts_that_fail_are_counted():
    scene = scenes.two_link_circle()._replace(t1=0.2)
    gains = gains_of(scene)
    bounds = (gains, gains * 1e100)  # so stiff that the first steps fail
    # As many as in another test, whose program it shares.
    result = fj.tune(scene, bounds=bounds, starts=6, max_steps=1)
    assert np.isnan(result.losses).sum() >= 1
    failed = np.isnan(result.losses).sum()
    assert f"{failed} of 6 starts could not be simulated" in str(result)
    assert np.isfinite(result.loss)


@pytest.mark.slow
def test_gains_of_zero_and_fixed_gains_stay_and_are_not_held():
    scene = with_changes(scenes.two_link_circle(), kd=[10.0, 0.0])._replace(t1=0.5)
    gains = gains_of(scene)
    _, lower, upper = bounds_of(scene, None, (gains / 2, 2 * gains + 1))
    assert lower[1, 1] == upper[1, 1] == 0 and upper[1, 0] == 21
    room = np.array([[4, 1], [4, 4]])
    result = fj.tune(scene, bounds=(gains / room, gains * room), max_steps=2)
    assert result.scene.forces[0].kd[1] == 0
    assert result.loss < result.history.loss[0]
    np.testing.assert_allclose(result.gains[0, 1], 100)
    assert not result.at_bound[:, 1].any()
    assert "of 2 gains" in result.message


class TestTracking:
    # Of two joints, whose programs compile faster.
    scene = scenes.two_link_circle()._replace(t1=1.0)

    @pytest.mark.slow
    def test_prices_are_those_of_the_documentation(self):
        scene = self.scene
        solution = fj.simulate(scene, np.linspace(0, 1, 1001))
        relative = fj.joint_efforts(scene, solution).total / scene.forces[0].limit[None]
        rates = np.diff(relative, axis=0) / 1e-3
        expected = (
            losses_of(scene, gains_of(scene)[None])[0]
            + 0.1 * np.mean(np.sum(np.square(relative), axis=1))
            + 1e-4 * np.mean(np.sum(rates**2, axis=1))
        )
        loss = fj.tuning.Tracking(effort=0.1, effort_rate=1e-4)
        residuals = residuals_of(scene, gains_of(scene), loss)
        assert float(residuals @ residuals) == pytest.approx(float(expected), rel=1e-10)

    @pytest.mark.slow
    def test_a_higher_price_buys_less_effort_in_one_program(self):
        losses = [fj.tuning.Tracking(effort=price) for price in (0.0, 1e-2, 1.0)]
        tuned = lambda loss: fj.tune(self.scene, loss=loss, max_steps=15)
        front = [tuned(losses[0])]
        compiled = search._evaluate.__wrapped__._cached._cache_size()
        front += map(tuned, losses[1:])
        assert search._evaluate.__wrapped__._cached._cache_size() == compiled
        for loss, result in zip(losses, front):
            residuals = residuals_of(self.scene, result.gains, loss)
            assert result.loss == pytest.approx(residuals @ residuals, rel=1e-5)
        effort, error = np.array([(r.effort, r.tip_error) for r in front]).T
        assert (np.diff(effort) < 0).all() and (np.diff(error) > 0).all()


class MeanSquare(eqx.Module):
    """A scalar loss, the mean square."""

    factor: jax.Array

    def __call__(self, scene, solution):
        return self.factor * jnp.mean(solution.q**2)


@pytest.mark.slow
def test_a_scalar_loss_is_the_loss_itself():
    scene = scenes.two_link_circle()._replace(t1=0.2)
    loss = MeanSquare(jnp.array(1.0))
    result = fj.tune(scene, loss=loss, method="l-bfgs", max_steps=1)
    found = residuals_of(scene, gains_of(scene), loss)
    assert result.history.loss[0] == pytest.approx(found, rel=1e-6)
    with pytest.raises(ValueError, match="loss: expected finite residuals, or one"):
        fj.tune(scene, loss=MeanSquare(jnp.array(-1.0)))


def test_a_gradient_of_zero_is_not_taken_for_convergence():
    scene = with_changes(scenes.two_link_circle(), limit=np.full(2, 1e-6))
    result = fj.tune(scene._replace(t1=0.05))
    assert not result.converged
    assert "every actuator is at its limit" in result.message
    assert "R2 is at its limit for 100 % of the time, so its gains" in result.message
    assert (result.history.saturated[0] == 1).all()


class Indexed(eqx.Module):
    """An effort on one joint, given by an index, with a table of whole numbers."""

    joint: int
    on: bool
    table: jax.Array

    def __call__(self, t, q, qd, linkage):
        return jnp.zeros(2).at[self.table[self.joint]].set(-5.0 if self.on else 0.0)


@pytest.mark.slow
def test_own_loss_and_all_kinds_of_elements_beside_the_controller():
    """An element with indices, a plain function and a prescribed motion."""

    def twice(scene, solution):
        return 2 * tip_errors(scene, solution)

    # Of two joints, whose programs compile faster.
    scene = scenes.two_link_circle()._replace(t1=1)
    controller = scene.forces[0]
    push = Indexed(1, True, jnp.array([1, 0]))
    wind = lambda strength: lambda t, q, qd, linkage: [0, strength]
    hold = lambda t, linkage: (jnp.asarray(scene.state0.q), jnp.zeros(2))
    held = fj.simulation.PrescribedMotion(1, hold)
    trial = scene._replace(forces=(controller, push, wind(10), held))
    result = fj.tune(trial, loss=twice, max_steps=2)

    @jax.jit
    def square(strength):
        blown = trial._replace(forces=(controller, push, wind(strength), held))
        ts, forward = np.linspace(0, trial.t1, 1001), diffrax.ForwardMode()
        motion = fj.simulate(blown, ts, adjoint=forward)
        return jnp.sum(tip_errors(trial, motion) ** 2)

    found, calm = float(square(10.0)), float(square(0.0))
    assert result.history.loss[0] == pytest.approx(4 * found, rel=1e-6)
    assert result.history.tip_error[0] ** 2 == pytest.approx(found, rel=1e-6)
    assert result.loss < 4 * found
    assert abs(found - calm) > 1e-3 * calm


@pytest.mark.slow
def test_two_links_and_a_fixed_pair_between_them_are_tuned_alike():
    scene = scenes.two_link_circle()
    result = fj.tune(scene)
    first, last = result.histories[0].tip_error[[0, -1]]
    assert result.converged and last < first / 2
    assert result.table["joint"] == ["R1", "R2"] * 2
    assert len(str(result).splitlines()) == 10
    bent = fj.Linkage(
        "RFR", length=[0, 0.5, 0.5, 0.8], com=[[0.25, 0], [0.25, 0], [0.4, 0]],
        mass=[1, 1, 1], inertia=[1 / 48, 1 / 48, 0.8**2 / 12], gravity=0,
    )  # fmt: skip
    q = fj.inverse_kinematics(bent, [1.1, 0], None)
    control = fj.PDController(100, 10, [60, 1, 30], scene.forces[0].reference)
    bent_scene = fj.Scene(bent, fj.State(q, np.zeros(3)), (control,), scene.t1)
    same = fj.tune(bent_scene)
    assert same.tip_error == pytest.approx(result.tip_error, rel=1e-3)
    np.testing.assert_allclose(same.gains[:, [0, 2]], result.gains, rtol=0.02)
    assert "F2" in str(same)
