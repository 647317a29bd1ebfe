"""Gravity feed-forward against Fig 7's table; computed torque's error dynamics."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from elements import MOVE, arm
from helpers import random_linkage

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.analysis.tracking import relative_demands, tip_deviation

each_topology = pytest.mark.parametrize("topology", fj.TOPOLOGIES)
FREE = (8.0, 5.0, jnp.inf, MOVE)  # gains, limit and reference


def heavier(linkage):
    return eqx.tree_at(lambda k: k.mass, linkage, 1.3 * linkage.mass)


def sample(topology):
    rng = np.random.default_rng(3)
    return random_linkage(topology, rng), *rng.uniform(-2, 2, (2, 3))


@jax.jit
def demanded_by(controller, t, q, qd, linkage):
    return controller.demand(t, q, qd, linkage)


# Gravity feed-forward


@each_topology
def test_the_weight_is_held_where_the_arm_is(topology):
    linkage, q, qd = sample(topology)
    plain = demanded_by(fj.PDController(*FREE), 0.4, q, qd, linkage)
    for model in None, heavier(linkage):
        controller = fj.control.GravityFeedforward(*FREE, model)
        held = fj.analysis.holding_efforts(linkage if model is None else model, q)
        found = demanded_by(controller, 0.4, q, qd, linkage)
        np.testing.assert_allclose(found, plain + held, rtol=1e-12, atol=1e-12)


def test_the_whole_effort_is_limited():
    linkage, q, qd = sample("RPR")
    free = demanded_by(fj.control.GravityFeedforward(*FREE), 0.4, q, qd, linkage)
    limit = np.abs(free) * [0.5, 2, 0.9]
    controller = fj.control.GravityFeedforward(*FREE[:2], limit, MOVE)
    expected = np.clip(free, -limit, limit)
    np.testing.assert_allclose(controller(0.4, q, qd, linkage), expected)


def fed_forward():
    scene = scenes.fig7()
    pd = scene.forces[0]
    controller = fj.control.GravityFeedforward(pd.kp, pd.kd, pd.limit, pd.reference)
    return scene._replace(forces=(controller,))


def test_fig_7_with_gravity_held():
    scene = fed_forward()
    (controller,) = scene.forces
    raw = demanded_by(controller, 0.0, *scene.state0, scene.linkage)
    np.testing.assert_allclose(raw, [-82.23, -5009.92, -9.92], atol=5e-3)
    known = {
        0: 0.25, 0.1: 0.126453, 0.2: 0.096059, 0.3: 0.126177, 0.5: 0.067283,
        0.75: 0.090121, 1: 0.106396, 1.5: 0.016605, 2: 0.029890, 3: 0.023419,
        5: 0.012562, 10: 0.011217,
    }  # fmt: skip
    early = [t for t in known if t < 5]
    ts = np.array([*early, *np.linspace(5, 10, 501)])
    solution = fj.simulate(scene.linkage, scene.state0, ts, scene.forces)
    deviation = tip_deviation(scene.linkage, controller.reference, solution)
    error = np.linalg.norm(deviation, axis=1)
    table = [*error[: len(early) + 1], error[-1]]
    np.testing.assert_allclose(table, list(known.values()), atol=2e-6)
    turn = error[len(early) :]
    assert np.sqrt(np.mean(turn**2)) == pytest.approx(0.024625, abs=2e-5)
    assert turn.max() == pytest.approx(0.036390, abs=2e-6)
    # The slide is at its limit until 0.25 s, the turning joints never.
    at_limit = jnp.abs(relative_demands(controller, scene.linkage, solution)) > 1
    assert at_limit[ts < 0.2, 1].any() and not at_limit[:, [0, 2]].any()
    assert not at_limit[ts > 0.26].any()


@pytest.mark.slow
def test_its_gains_are_tuned():
    scene = fed_forward()._replace(t1=1.0)
    result = fj.tune(scene, max_steps=3)
    assert isinstance(result.scene.forces[0], fj.control.GravityFeedforward)
    assert result.loss < 0.8 * result.history.loss[0]


# Computed torque


@each_topology
def test_the_effort_is_the_inverse_dynamics_of_what_is_demanded(topology):
    linkage, q, qd = sample(topology)
    (q_ref, qd_ref), h = MOVE(0.4, linkage), 1e-6
    qdd_ref = (MOVE(0.4 + h, linkage)[1] - MOVE(0.4 - h, linkage)[1]) / (2 * h)
    demanded = qdd_ref + 8 * (q_ref - q) + 5 * (qd_ref - qd)
    for model in None, heavier(linkage):
        controller = fj.control.ComputedTorque(*FREE, model)
        believed = linkage if model is None else model
        expected = fj.inverse_dynamics(believed, q, qd, demanded)
        found = demanded_by(controller, 0.4, q, qd, linkage)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


@each_topology
def test_errors_of_an_exact_model_are_linear(topology):
    """d2e/dt2 + kd de/dt + kp e = 0, critically damped, underdamped and overdamped."""
    linkage, ts = arm(topology), np.linspace(0, 1.5, 4)
    kp, kd = np.array([9.0, 25.0, 16.0]), np.array([6.0, 4.0, 10.0])
    controller = fj.control.ComputedTorque(kp, kd, jnp.inf, MOVE)
    error, rate = np.array([0.2, -0.1, 0.3]), np.array([-0.5, 0.4, 0.1])
    q, qd = MOVE(0.0, linkage)
    solution = fj.simulate(linkage, fj.State(q - error, qd - rate), ts, (controller,))
    q_ref, _ = jax.vmap(lambda t: MOVE(t, linkage))(ts)
    # Eigenvalues of each joint's companion matrix.
    matrices = [[[0, 1], [-p, -d]] for p, d in zip(kp, kd)]
    grown = scipy.linalg.expm(ts[:, None, None, None] * np.array(matrices))
    start = np.stack([error, rate], axis=1)
    expected = np.einsum("tjab,jb->tja", grown, start)[..., 0]
    np.testing.assert_allclose(q_ref - solution.q, expected, atol=1e-8)


def test_the_acceleration_is_that_of_the_inverse_kinematics():
    linkage, task, t, h = scenes.fig7().linkage, fj.CircleTask(), 0.7, 1e-5
    rates = [task(t + step, linkage)[1] for step in (h, -h)]
    controller = fj.control.ComputedTorque(100.0, 20.0, jnp.inf, task)
    schedule = jax.jit(lambda t: controller.schedule(t, linkage))
    q_ref, qd_ref, qdd_ref = schedule(t)
    np.testing.assert_allclose(qdd_ref, (rates[0] - rates[1]) / (2 * h), atol=1e-7)
    np.testing.assert_allclose((q_ref, qd_ref), task(t, linkage), rtol=1e-12)


# Models


@pytest.mark.parametrize(
    "kind", [fj.control.GravityFeedforward, fj.control.ComputedTorque]
)
def test_models_are_checked(kind):
    linkage = arm("RPR")
    for model, message in (
        ("RPR", "model: expected a Linkage, got 'RPR'"),
        (eqx.tree_at(lambda k: k.mass, linkage, -linkage.mass), "model.mass: expected"),
    ):
        with pytest.raises(ValueError, match=message):
            kind(*FREE, model)
    controller = kind(*FREE, arm("RRR"))
    state = fj.State(np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="model: expected the arm's own topology"):
        fj.simulate(linkage, state, [0, 0.1], (controller,))
    assert isinstance(controller, fj.PDController) and controller.possible()
