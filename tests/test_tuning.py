"""Gain tuning: converges within its bounds, to what no random search beats."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import scenes, tuning


def losses(scene, result, count):
    """Mean squared tip errors of random gains inside the bounds and of the tuned."""

    @jax.jit
    def loss(gains):
        trial = tuning._with_gains(scene, gains)
        solution = fj.simulate(
            trial.linkage,
            trial.state0,
            jnp.linspace(0, trial.t1, 1001),
            trial.forces,
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
        )
        return jnp.sum(tuning.tip_errors(trial, solution) ** 2)

    low, high = np.log(result.lower), np.log(result.upper)
    rng = np.random.default_rng(0)
    random = [jnp.exp(rng.uniform(low, high)) for _ in range(count)]
    return [float(loss(gains)) for gains in (*random, result.history.gains[-1])]


@pytest.mark.parametrize("factor", [4.0, 10.0])
def test_no_random_gains_do_better(factor):
    scene = scenes.fig7()
    result = fj.tune(scene, factor=factor)
    history = result.history
    assert result.converged
    assert history.gradient_norm[-1] <= 1e-3 * history.gradient_norm[0]
    assert (np.diff(history.loss) < 0).all()
    gains = history.gains[-1]
    margin = 1 + 1e-12
    assert (gains >= result.lower / margin).all()
    assert (gains <= result.upper * margin).all()
    tuned = result.scene.forces[0]
    np.testing.assert_array_equal([tuned.kp, tuned.kd], gains)
    assert result.loss == history.loss[-1]
    *random, tuned_loss = losses(scene, result, 200)
    # The same measure for all, at a coarser tolerance than the tuner's own.
    assert tuned_loss == pytest.approx(result.loss, rel=0.01)
    assert min(random) > tuned_loss
    assert "gains are at a bound" in result.message


def test_history_describes_each_iteration_and_a_second_call_compiles_nothing():
    scene = scenes.fig7()._replace(t1=1.0)
    first = fj.tune(scene, max_steps=3)
    n = len(first.history.loss)
    assert first.history.gains.shape == (n, 2, 3)
    assert first.history.saturated.shape == (n, 3)
    assert (np.diff(first.history.wall_time) > 0).all()
    # The slide's actuator starts saturated, the others never are.
    assert first.history.saturated[0, 1] > 0
    assert (first.history.saturated[0, [0, 2]] == 0).all()
    compiled = tuning._evaluate._cached._cache_size()
    task = fj.CircleTask(center=(-3.9, 2.1), radius=0.6)
    other = scenes.fig7().forces[0]
    other = fj.PDController(other.kp * 1.1, other.kd, other.limit, task)
    fj.tune(scene._replace(forces=(other,), t1=0.9), factor=3.0, max_steps=1)
    assert tuning._evaluate._cached._cache_size() == compiled


def test_adam_descends_and_stays_within_explicit_bounds():
    scene = scenes.fig7()._replace(t1=1.0)
    gains = np.stack([scene.forces[0].kp, scene.forces[0].kd])
    bounds = (gains / 1.2, gains * 1.2)
    result = fj.tune(scene, bounds=bounds, method="adam", max_steps=8)
    assert "stopped after 8 evaluations" in result.message
    assert result.loss == result.history.loss.min() < result.history.loss[0]
    assert (result.history.gains <= bounds[1] * (1 + 1e-12)).all()
    assert (result.history.gains >= bounds[0] / (1 + 1e-12)).all()


def test_gains_of_zero_stay_zero():
    scene = scenes.fig7()._replace(t1=0.5)
    controller = scene.forces[0]
    without = fj.PDController(
        controller.kp, [80.0, 0.0, 50.0], controller.limit, controller.reference
    )
    result = fj.tune(scene._replace(forces=(without,)), max_steps=2)
    assert result.scene.forces[0].kd[1] == 0
    assert result.loss < result.history.loss[0]


def test_own_loss():
    def effort_too(scene, solution):
        efforts = fj.joint_efforts(scene.linkage, scene.forces, solution).total
        return jnp.concatenate(
            [tuning.tip_errors(scene, solution), 1e-5 * efforts.reshape(-1)]
        )

    scene = scenes.fig7()._replace(t1=0.5)
    result = fj.tune(scene, loss=effort_too, max_steps=3)
    assert result.loss < result.history.loss[0]


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        (dict(factor=1.0), "factor"),
        (dict(factor="4"), "factor"),
        (dict(method="newton"), "method"),
        (dict(max_steps=0), "max_steps"),
        (dict(max_steps=2.5), "max_steps"),
        (dict(max_steps=True), "max_steps"),
        (dict(progress_meter=None), "progress_meter"),
        (dict(loss=3), "loss"),
        (dict(bounds=(1, 2, 3)), "bounds"),
        (dict(bounds=(np.ones((2, 3)), np.ones((2, 2)))), "bounds"),
        (dict(bounds=(np.ones((2, 3)), 2 * np.ones((2, 3)))), "bounds"),
        (dict(bounds=(np.zeros((2, 3)), np.full((2, 3), 1e9))), "bounds"),
    ],
)
def test_malformed_arguments(keywords, message):
    with pytest.raises(ValueError, match=message):
        fj.tune(scenes.fig7(), **keywords)


@pytest.mark.parametrize(
    "scene",
    [
        scenes.fig5(),
        5,
        None,
        scenes.fig7()._replace(t1=-1.0),
        scenes.fig7()._replace(t1=np.nan),
        scenes.fig7()._replace(t1="a"),
        scenes.fig7()._replace(linkage=None),
        scenes.fig7()._replace(forces=scenes.fig7().forces[0]),
    ],
)
def test_malformed_scenes(scene):
    """Without exactly one controller, or not a scene at all."""
    with pytest.raises(ValueError, match="scene|linkage"):
        fj.tune(scene)


def test_a_gradient_of_zero_is_not_taken_for_convergence():
    scene = scenes.fig7()._replace(t1=0.2)
    weak = scene.forces[0]
    weak = fj.PDController(weak.kp, weak.kd, 1e-6, weak.reference)
    result = fj.tune(scene._replace(forces=(weak,)))
    assert not result.converged
    assert "every actuator is at its limit" in result.message
    assert (result.history.saturated[0] == 1).all()


def test_a_plain_function_may_act_beside_the_controller():
    scene = scenes.fig7()._replace(t1=0.2)
    wind = lambda t, q, qd, linkage: [0, 1, 0]
    result = fj.tune(scene._replace(forces=(*scene.forces, wind)), max_steps=1)
    assert result.loss <= result.history.loss[0]


def test_a_scalar_loss_is_the_loss_itself():
    def mean_square(scene, solution):
        return jnp.mean(solution.q**2)

    scene = scenes.fig7()._replace(t1=0.2)
    result = fj.tune(scene, loss=mean_square, method="adam", max_steps=1)
    solution = fj.simulate(
        scene.linkage, scene.state0, np.linspace(0, 0.2, 1001), scene.forces
    )
    assert result.history.loss[0] == pytest.approx(
        np.mean(np.asarray(solution.q) ** 2), rel=1e-6
    )


def test_bounded_step_minimises_the_damped_model_in_its_box():
    """Against a fine random search, with and without active bounds."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        jacobian = rng.normal(size=(20, 3)) * [1, 10, 0.1]
        residual = rng.normal(size=20)
        low, high = -rng.uniform(0, 0.3, 3), rng.uniform(0, 0.3, 3)
        half = jacobian.T @ residual
        step = tuning._bounded_step(jacobian, half, 1e-3, low, high)
        assert (step >= low).all() and (step <= high).all()
        normal = jacobian.T @ jacobian
        normal += 1e-3 * np.diag(np.diag(normal))

        def model(s, half=half, normal=normal):
            return np.sum(s * half, -1) + np.einsum("...i,ij,...j", s, normal, s) / 2

        others = rng.uniform(low, high, (20000, 3))
        # One pass of clipping is near the box's optimum, never worse than no step.
        assert model(step) <= 0
        assert model(step) <= model(others).min() + 0.05 * abs(model(others).min())
