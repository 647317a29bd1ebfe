"""Linear analysis: slopes, arms at rest, modes along motions, the regressor."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Hold, random_motion
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.identification.result import inverse_and_null_space

each_topology = pytest.mark.parametrize("topology", fj.TOPOLOGIES)
STILL, PAYLOAD = np.zeros(3), fj.forces.Payload(fj.Point(3, 0.4), 0.4, 0.05)
ROD = fj.Linkage(
    "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1 / 12] * 3
)


def modes_at(linkage, forces, *states, ts=0.0):
    q, qd = (jnp.array(rows) for rows in zip(*states))
    ts = jnp.broadcast_to(ts, len(q))
    motion = fj.Solution(ts, q, qd, {}, diffrax.RESULTS.successful)
    return fj.analysis.closed_loop_modes(linkage, forces, motion)


def held(linkage, q, kp, kd):
    """Returns a PD controller under which the arm sags to `q`."""
    load = fj.analysis.holding_efforts(linkage, q)
    unlimited = [np.inf] * len(q)  # one per joint, as in the program of limited ones
    return fj.PDController(kp, kd, unlimited, Hold(q + load / np.array(kp)))


@partial(jax.jit, **LOOPS)
def rest(linkage, controller, guess):
    """Returns an equilibrium's derivative in kp, and the equilibrium."""

    def twice(kp):
        acting = eqx.tree_at(lambda c: c.kp, controller, kp)
        found = fj.analysis.equilibrium(linkage, guess, (acting,))
        return found, found

    return jax.jacfwd(twice, has_aux=True)(controller.kp)


def slopes(function, y, h=1e-6):
    ends = [(function(y + h * e), function(y - h * e)) for e in np.eye(len(y))]
    return np.stack([(a - b) / (2 * h) for a, b in ends], axis=1)


@pytest.mark.slow
@each_topology
def test_a_and_b_are_slopes(topology):
    linkage, q, qd, tau = random_motion(topology, 3)
    forces = fj.JointDamper(0.3), fj.JointEffort(tau), fj.forces.Armature(0.2)
    A, B = fj.linearize(linkage, fj.State(q, qd), forces)

    def rates(y, effort):
        total = tau - 0.3 * y[3:] + effort
        qdd = fj.forward_dynamics(linkage, y[:3], y[3:], total, forces)
        return np.concatenate([y[3:], qdd])

    y = np.concatenate([q, qd])
    by_y = slopes(lambda y: rates(y, STILL), y)
    by_u = slopes(lambda u: rates(y, u), STILL)
    np.testing.assert_allclose(A, by_y, atol=1e-7 * np.abs(A).max())
    np.testing.assert_allclose(B, by_u, atol=1e-7 * np.abs(B).max())


@pytest.mark.slow
def test_a_stiff_controller_of_limited_efforts_has_an_equilibrium():
    scene = fj.scenes.fig7()
    controller = scene.forces[0]
    # Where the circle begins; compiles faster than a reference that moves.
    reference = np.array([np.pi / 2, 2.25, -np.pi / 2])
    controller = eqx.tree_at(lambda c: c.reference, controller, Hold(reference))
    slope, q = rest(scene.linkage, controller, reference)
    efforts = controller(0.0, q, STILL, scene.linkage)
    weight = partial(fj.analysis.holding_efforts, scene.linkage)
    np.testing.assert_allclose(efforts, weight(q), rtol=1e-9)
    # The efforts kp (reference - q) hold the weight, whatever kp is.
    stiffness = np.diag(controller.kp) + slopes(weight, q)
    expected = np.linalg.solve(stiffness, np.diag(reference - q))
    np.testing.assert_allclose(slope, expected, rtol=1e-7, atol=1e-15)
    assert 0.01 < np.abs(q - reference).max() < 0.3
    # No equilibrium is found from a guess at which the slide is at its limit.
    saturated = rest(scene.linkage, controller, jnp.asarray(scene.state0.q))
    assert all(np.isnan(found).all() for found in saturated)


@pytest.mark.slow
@each_topology
def test_equilibria_are_where_the_efforts_hold_the_arm(topology):
    linkage, q, *_ = random_motion(topology, 3)
    tau = fj.analysis.holding_efforts(linkage, q, (PAYLOAD,))  # and its mass
    tau = tau + PAYLOAD(0.0, q, STILL, linkage)
    qdd = fj.forward_dynamics(linkage, q, STILL, tau, (PAYLOAD,))
    np.testing.assert_allclose(qdd, 0, atol=1e-9)
    controller = held(linkage, q, [300.0, 200.0, 100.0], np.ones(3))
    _, found = rest(linkage, controller, q + 0.05)
    np.testing.assert_allclose(found, q, atol=1e-8)


@pytest.mark.slow
def test_loads_that_nothing_holds_have_no_equilibrium():
    """A shoulder motor can be too weak or too strong for every posture."""
    for share in (0.95, 1.05):
        most = share * fj.analysis.holding_efforts(ROD, STILL)
        pushing = fj.PDController([1e6] * 3, np.ones(3), most, Hold(np.full(3, 9.0)))
        _, q = rest(ROD, pushing, jnp.array([0.4, 0.1, -0.1]))
        assert np.isfinite(q).all() == (share < 1)


# Modes; the doctest of `linearize` has known frequencies.


@pytest.mark.slow
def test_longer_steps_than_the_longest_are_unstable_and_fixed_pairs_have_no_modes():
    growth = lambda z: np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24).max()
    for kd in (0.5, 40.0):
        forces = (held(ROD, STILL, [400.0, 300.0, 200.0], [kd] * 3),)
        modes = modes_at(ROD, forces, (STILL, STILL), (STILL, STILL))
        z = modes.longest_step[0] * modes.eigenvalues[0]
        assert (modes.damping > 0).all() and growth(z) < 1 < growth(1.15 * z)
    linkage = ROD.replace(topology="RFR")
    forces = (held(linkage, STILL, [400.0, 0.0, 200.0], [10.0, 0.0, 6.0]),)
    modes = modes_at(linkage, forces, (STILL, STILL), (STILL * np.nan, STILL))
    assert modes.eigenvalues.shape == (2, 4) and np.isnan(modes.longest_step[1])
    assert modes.frequency[0].min() > 1 and (modes.damping[0] > 0).all()


def test_a_saturated_joint_has_no_gains():
    kp, kd = np.array([400.0, 300.0, 200.0]), np.array([10.0, 8.0, 6.0])
    target = jnp.array([0.3, -0.2, 0.1])
    controller = fj.PDController(kp, kd, [1e3, 30.0, 1e3], Hold(target))
    q = np.array([0.2, 0.4, 0.3])  # the second joint is off by 180 N m
    modes = modes_at(ROD, (controller,), (q, STILL), (np.array(target), STILL))

    def rates(y):
        efforts = kp * (target - y[:3]) - kd * y[3:]
        efforts = efforts.at[1].set(-30.0)
        return np.concatenate([y[3:], fj.forward_dynamics(ROD, y[:3], y[3:], efforts)])

    A = slopes(rates, np.concatenate([q, STILL]))
    expected = np.sort(np.abs(np.linalg.eigvals(A)))
    np.testing.assert_allclose(modes.frequency[0], expected, rtol=1e-6)
    assert modes.frequency[1, 0] > 1.3 * modes.frequency[0, 0]
    np.testing.assert_allclose(modes.longest_step, 2.6 / modes.frequency[:, -1])


DETERMINED = {"RPR": 9, "PRR": 7}


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0, 0))
def of_samples(*motion):
    return fj.analysis.regressor(*motion), fj.inverse_dynamics(*motion)


@each_topology
def test_the_regressor_times_the_parameters_is_the_inverse_dynamics(topology):
    """Some combinations of the twelve parameters are identified."""
    linkage, *_ = random_motion(topology)
    samples = np.random.default_rng(1).uniform(-2, 2, (3, 40, 3))
    matrix, tau = of_samples(linkage, *samples)
    found = np.einsum("tjlp,lp->tj", matrix, fj.analysis.inertial_parameters(linkage))
    np.testing.assert_allclose(found, tau, rtol=1e-9, atol=1e-9)
    rows = np.asarray(matrix).reshape(120, 12)
    if count := DETERMINED.get(topology):
        values = np.linalg.svd(rows, compute_uv=False)
        assert values[count - 1] > 1e-3 * values[0]
        assert values[count] < 1e-12 * values[0]
        # Identification leaves the others as they are.
        _, null = inverse_and_null_space(rows.T @ rows)
        assert null.shape == (12, 12 - count)
        np.testing.assert_allclose(rows @ null, 0, atol=1e-5 * values[0])
