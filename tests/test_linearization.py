"""Linear analysis: slopes, arms at rest, modes along motions, the regressor."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chains import Hold
from helpers import random_motion
from modes import LOOPS
from test_reactions import ACTUATOR

import fdof_jax as fj

each_topology = pytest.mark.parametrize("topology", fj.TOPOLOGIES)
STILL = np.zeros(3)
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
    columns = [
        (function(y + h * e) - function(y - h * e)) / (2 * h) for e in np.eye(len(y))
    ]
    return np.stack(columns, axis=1)


# A and B


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
    reference, _ = controller.reference(0.0, scene.linkage)
    # Compiles faster than a reference that moves.
    controller = eqx.tree_at(lambda c: c.reference, controller, Hold(reference))
    slope, q = rest(scene.linkage, controller, reference)
    efforts = controller(0.0, q, STILL, scene.linkage)
    weight = partial(fj.analysis.holding_efforts, scene.linkage)
    np.testing.assert_allclose(efforts, weight(q), rtol=1e-9)
    # The efforts kp (reference - q) hold the weight, whatever kp is.
    stiffness = np.diag(controller.kp) + jax.jacfwd(weight)(q)
    expected = np.linalg.solve(stiffness, np.diag(reference - q))
    np.testing.assert_allclose(slope, expected, rtol=1e-7, atol=1e-15)
    assert 0.01 < np.abs(q - reference).max() < 0.3
    # No equilibrium is found from a guess at which the slide is at its limit.
    saturated = rest(scene.linkage, controller, jnp.asarray(scene.state0.q))
    assert all(np.isnan(found).all() for found in saturated)


# Equilibria


@pytest.mark.slow
@each_topology
def test_equilibria_are_where_the_efforts_hold_the_arm(topology):
    linkage, q, *_ = random_motion(topology, 3)
    tau = fj.analysis.holding_efforts(linkage, q, (ACTUATOR,))  # and its masses
    tau = tau + ACTUATOR(0.0, q, STILL, linkage)
    qdd = fj.forward_dynamics(linkage, q, STILL, tau, (ACTUATOR,))
    np.testing.assert_allclose(qdd, 0, atol=1e-9)
    controller = held(linkage, q, [300.0, 200.0, 100.0], np.ones(3))
    _, found = rest(linkage, controller, q + 0.05)
    np.testing.assert_allclose(found, q, atol=1e-8)


@pytest.mark.parametrize("q", [-1.2, 0.4])
def test_forces_carry_their_part_of_the_load(q):
    rod = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
    # A spring of no length balances a pendulum at any angle.
    ends = fj.Point(0, 0, 1), fj.Point(1, 0.5)
    spring = fj.SpringDamper(*ends, stiffness=9.81, damping=3.0)
    push = fj.forces.EffortHistory([0.0, 1.0], [[0.0], [2.0]])
    found = fj.analysis.holding_efforts(rod, [q], (spring, push), 0.5)
    np.testing.assert_allclose(found, [-1.0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("share, found", [(0.95, True), (1.05, False)])
def test_loads_that_nothing_holds_have_no_equilibrium(share, found):
    """A shoulder motor can be too weak or too strong for every posture."""
    tau = share * fj.analysis.holding_efforts(ROD, STILL)
    q = fj.analysis.equilibrium(ROD, [0.4, 0.1, -0.1], (fj.JointEffort(tau),))
    assert np.isfinite(q).all() == found
    if found:
        np.testing.assert_allclose(fj.analysis.holding_efforts(ROD, q), tau, atol=1e-9)


# Modes


@pytest.mark.slow
def test_a_hanging_chain_of_point_masses_swings_as_is_known():
    """Squared frequencies in g/l are the zeros of Laguerre's L3."""
    linkage = fj.scenes.fig5().linkage
    hanging, failed = ([-np.pi / 2, 0.0, 0.0], STILL), ([0.3, np.nan, 0.0], STILL)
    free = (fj.JointDamper(0.0),)  # shares the program of Fig 3
    modes = modes_at(linkage, free, hanging, failed)
    zeros = np.polynomial.laguerre.lagroots([0, 0, 0, 1])
    expected = np.repeat(np.sqrt(9.81 * zeros), 2)
    np.testing.assert_allclose(modes.frequency[0], expected, rtol=1e-9)
    np.testing.assert_allclose(modes.damping[0], 0, atol=1e-9)
    assert np.isnan(modes.eigenvalues[1]).all() and np.isnan(modes.longest_step[1])
    weightless = eqx.tree_at(lambda k: k.gravity, linkage, jnp.array(0.0))
    drifting = modes_at(weightless, free, (STILL + 0.3, STILL), (STILL, STILL))
    assert (drifting.longest_step > 10).all()  # nothing to be stable against


def test_the_modes_of_fig_3_at_rest():
    scene = fj.scenes.fig3()
    absolute = np.array([-47.72631099390626, -135, -45]) * np.pi / 180
    q = np.diff(absolute, prepend=0)
    modes = modes_at(scene.linkage, scene.forces, (q, STILL), (q, STILL))
    # From an independent computation, to four digits.
    known = [-0.4033, -1.645, -0.3471 - 2.1239j, -0.3471 + 2.1239j, -6.161, -31.36]
    found = modes.eigenvalues[0]
    found[2:4] = found[2:4][np.argsort(found[2:4].imag)]
    np.testing.assert_allclose(found, known, rtol=2e-4)
    np.testing.assert_allclose(modes.damping[0, [0, 5]], 1)
    np.testing.assert_allclose(modes.damping[0, 2], 0.3471 / abs(known[2]), rtol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kd", [0.5, 10.0, 40.0])
def test_longer_steps_than_the_longest_are_unstable(kd):
    forces = (held(ROD, STILL, [400.0, 300.0, 200.0], [kd] * 3),)
    modes = modes_at(ROD, forces, (STILL, STILL), (STILL, STILL))
    z = modes.longest_step[0] * modes.eigenvalues[0]
    growth = lambda z: np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24).max()
    assert (modes.damping > 0).all()
    assert growth(z) < 1 < growth(1.15 * z)


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


@pytest.mark.slow
def test_fixed_pairs_have_no_modes():
    linkage = ROD.replace(topology="RFR")
    forces = (held(linkage, STILL, [400.0, 0.0, 200.0], [10.0, 0.0, 6.0]),)
    modes = modes_at(linkage, forces, (STILL, STILL), (STILL, STILL))
    assert modes.eigenvalues.shape == (2, 4)
    full = np.asarray(fj.linearize(linkage, fj.State(STILL, STILL), forces).A)
    moving = np.array([0, 2, 3, 5])
    expected = np.abs(np.linalg.eigvals(full[np.ix_(moving, moving)]))
    np.testing.assert_allclose(modes.frequency[0], np.sort(expected), rtol=1e-9)
    assert modes.frequency.min() > 1 and (modes.damping > 0).all()


# The regressor


@each_topology
def test_the_regressor_times_the_parameters_is_the_inverse_dynamics(topology):
    linkage, q, qd, qdd = random_motion(topology, 3)
    matrix = fj.analysis.regressor(linkage, q, qd, qdd)
    tau = jnp.einsum("jlp,lp->j", matrix, fj.analysis.inertial_parameters(linkage))
    exact = fj.inverse_dynamics(linkage, q, qd, qdd)
    np.testing.assert_allclose(tau, exact, rtol=1e-10, atol=1e-10)


def test_nine_combinations_of_the_parameters_of_an_rpr_arm_are_identified():
    """Three combinations are lost.

    The first link's mass has no effect. The second link's inertia adds to the
    first's, as both turn together. The third link's mass adds to the second's, to
    which it is hinged.
    """
    linkage, *_ = random_motion("RPR", 3)
    samples = np.random.default_rng(1).uniform(-2, 2, (3, 40, 3))
    stacked = jax.vmap(lambda *row: fj.analysis.regressor(linkage, *row))(*samples)
    matrix = np.asarray(stacked).reshape(120, 12)
    values = np.linalg.svd(matrix, compute_uv=False)
    assert values[8] > 1e-3 * values[0] and values[9] < 1e-12 * values[0]
    np.testing.assert_allclose(matrix[:, 0], 0, atol=1e-12)
