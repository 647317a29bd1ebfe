"""Controllers: the saturated PD law, feed-forward, computed torque, gains."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from elements import MOVE, arm as small_arm
from helpers import random_linkage

import fdof_jax as fj
from fdof_jax.tuning.losses import relative_demands, tip_deviation, with_gains

each_topology = pytest.mark.parametrize("topology", fj.TOPOLOGIES)
FREE = (8.0, 5.0, jnp.inf, MOVE)  # gains, limit and reference
PENDULUM = fj.Linkage(
    "R", length=[0, 1], com=[[0.6, 0.2]], mass=[2], inertia=[0.3], gravity=9.81
)


class Stand(fj.references.Reference):
    target: fj.Values = fj.field(unit="m or rad")

    def __call__(self, t, linkage):
        return self.target, 0 * self.target


def arm(topology, seed=0):
    rng = np.random.default_rng(seed)
    return random_linkage(topology, rng), rng.uniform(-1, 1, 3)


def pd_at(q, kp, kd):
    n = len(q)
    full = lambda value: np.broadcast_to(value, n).astype(float)
    return fj.PDController(full(kp), full(kd), full(np.inf), Stand(q))


def poles(linkage, q, *forces):
    A, _ = fj.linearize(linkage, fj.State(q, 0 * q), forces)
    return np.linalg.eigvals(A)


# The PD law


@pytest.mark.parametrize("limit", [[3.0, 4.0, 5.0], [1e9, 0.0, np.inf]])
def test_the_controller_is_the_clipped_sum_of_both_errors(limit):
    rng = np.random.default_rng(0)
    linkage, _ = arm("RPR")
    q_ref, qd_ref = rng.normal(size=(2, 3))
    kp, kd = rng.uniform(0, 10, (2, 3))
    controller = fj.PDController(kp, kd, limit, lambda t, k: (q_ref * t, qd_ref))
    one = fj.PDController(2, 3, np.inf, lambda t, k: (jnp.ones(3), jnp.ones(3)))
    still = jnp.zeros(3)
    np.testing.assert_array_equal(one(0.0, still, still, linkage), [5, 5, 5])
    saturated = []
    for _ in range(50):
        q, qd = rng.normal(size=(2, 3))
        demand = kp * (2 * q_ref - q) + kd * (qd_ref - qd)
        limited = np.maximum(-np.array(limit), np.minimum(limit, demand))
        np.testing.assert_allclose(controller.demand(2.0, q, qd, linkage), demand)
        np.testing.assert_allclose(controller(2.0, q, qd, linkage), limited)
        saturated.append(np.abs(demand) > limit)
    assert 0 < np.mean(saturated) < 1


def test_gradients_in_the_gains_stop_where_the_effort_is_limited():
    error, rate = jnp.array([2.0, -3.0, 0.5]), jnp.array([0.1, 0.2, -0.3])
    linkage, _ = arm("RRR")
    controller = fj.PDController(
        [100, 1, 1], [1, 1, 1], [5, 50, 50], lambda t, k: (error, rate)
    )

    def effort(controller):
        return jnp.sum(controller(0.0, jnp.zeros(3), jnp.zeros(3), linkage))

    gradient = eqx.filter_grad(effort)(controller)
    np.testing.assert_allclose(gradient.kp, [0, -3, 0.5])
    np.testing.assert_allclose(gradient.kd, [0, 0.2, -0.3])
    np.testing.assert_allclose(gradient.limit, [1, 0, 0])


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
    # The whole effort is limited.
    limit = np.abs(found) * [0.5, 2, 0.9]
    limited = fj.control.GravityFeedforward(*FREE[:2], limit, MOVE, model)
    expected = np.clip(found, -limit, limit)
    np.testing.assert_allclose(limited(0.4, q, qd, linkage), expected, atol=1e-12)


def fed_forward():
    scene = fj.scenes.fig7()
    pd = scene.forces[0]
    controller = fj.control.GravityFeedforward(pd.kp, pd.kd, pd.limit, pd.reference)
    return scene._replace(forces=(controller,))


@pytest.mark.slow
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


def test_its_gains_are_those_that_are_tuned():
    tuned = with_gains(fed_forward(), np.ones((2, 3))).forces[0]
    assert isinstance(tuned, fj.control.GravityFeedforward)
    np.testing.assert_array_equal([tuned.kp, tuned.kd], 1)


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


@pytest.mark.slow
def test_errors_of_an_exact_model_are_linear():
    """d2e/dt2 + kd de/dt + kp e = 0, critically damped, underdamped and overdamped."""
    linkage, ts = small_arm("RPR"), np.linspace(0, 1.5, 4)
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
    linkage, task, t, h = fj.scenes.fig7().linkage, fj.CircleTask(), 0.7, 1e-5
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
    linkage = small_arm("RPR")
    for model, message in (
        ("RPR", "model: expected a Linkage, got 'RPR'"),
        (eqx.tree_at(lambda k: k.mass, linkage, -linkage.mass), "model.mass: expected"),
    ):
        with pytest.raises(ValueError, match=message):
            kind(*FREE, model)
    controller = kind(*FREE, small_arm("RRR"))
    state = fj.State(np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="model: expected the arm's own topology"):
        fj.simulate(linkage, state, [0, 0.1], (controller,))
    assert isinstance(controller, fj.PDController) and controller.possible()


# Gains


@pytest.mark.slow
@pytest.mark.parametrize("joint", range(3))
def test_a_joint_that_moves_alone_has_the_frequency_and_the_damping(joint):
    linkage, q = arm("RRR")
    linkage = linkage.replace(gravity=0, locked=0)
    frequency, ratio = np.array([3.0, 5.0, 8.0]), np.array([0.2, 0.7, 1.0])
    gains = fj.control.gains_from_frequency(linkage, q, frequency, ratio)
    others = "".join("R" if k == joint else "F" for k in range(3))
    alone = linkage.replace(topology=others, locked=q)
    found = poles(alone, q, pd_at(q, *gains))
    omega, zeta = frequency[joint], ratio[joint]
    expected = np.roots([1, 2 * zeta * omega, omega**2])
    found = found[np.abs(found) > 1e-6]  # without those of the fixed pairs
    np.testing.assert_allclose(np.poly(found), np.poly(expected), rtol=1e-9)
    fixed = fj.control.gains_from_frequency(alone, q, frequency, ratio)
    np.testing.assert_allclose(fixed, np.eye(3)[joint] * gains, rtol=1e-12)


def test_gains_count_masses_of_elements():
    linkage, q = arm("RPR")
    bare = fj.control.gains_from_frequency(linkage, q, 4.0, 0.5)
    more = np.array([1.0, 2.0, 3.0])
    forces = (fj.forces.Armature(more),)
    geared = fj.control.gains_from_frequency(linkage, q, 4.0, 0.5, forces)
    np.testing.assert_allclose(geared[0] - bare[0], 16 * more, rtol=1e-12)
    np.testing.assert_allclose(geared[1] - bare[1], 4 * more, rtol=1e-12)
