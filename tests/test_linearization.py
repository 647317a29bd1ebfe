"""Linear analysis: differences, small motions, equilibria, regressor."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from chains import Hold, random_chain
from helpers import random_linkage
from modes import LOOPS
from test_reactions import TipLoad

import fdof_jax as fj
from fdof_jax import scenes

each_topology = pytest.mark.parametrize("topology", fj.TOPOLOGIES)
STILL = np.zeros(3)
ROD = fj.Linkage(
    "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[1 / 12] * 3
)


def motion(topology, seed=0):
    rng, n = np.random.default_rng(seed), len(topology)
    linkage = random_linkage(topology, rng) if n == 3 else random_chain(topology, rng)
    return linkage, *rng.uniform(-1, 1, (3, n))


def modes_at(linkage, forces, *states, ts=0.0):
    q, qd = (jnp.array(rows) for rows in zip(*states))
    ts = jnp.broadcast_to(ts, len(q))
    motion = fj.Solution(ts, q, qd, {}, diffrax.RESULTS.successful)
    return fj.analysis.closed_loop_modes(linkage, forces, motion)


def held(linkage, q, kp, kd, others=()):
    """Returns a PD controller under which the arm sags to `q`."""
    load = fj.analysis.holding_efforts(linkage, q, others)
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


@each_topology
def test_a_and_b_are_slopes(topology):
    linkage, q, qd, tau = motion(topology)
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
def test_small_deviations_follow_the_exponential_of_a():
    # Of two joints, whose programs compile faster.
    linkage, q, *_ = motion("RP")
    forces = (held(linkage, q, [60.0, 90.0], [5.0, 3.0]),)
    np.testing.assert_allclose(
        fj.analysis.equilibrium(linkage, q + 0.05, forces), q, atol=1e-8
    )
    A, _ = fj.linearize(linkage, fj.State(q, np.zeros(2)), forces)
    deviation = 1e-5 * np.array([1, -2, 4, -5])
    start = fj.State(q + deviation[:2], deviation[2:])
    solution = fj.simulate(linkage, start, [0, 0.5], forces)
    found = np.concatenate([solution.q[-1] - q, solution.qd[-1]])
    expected = scipy.linalg.expm(0.5 * np.asarray(A)) @ deviation
    # The difference is of second order in the deviations.
    np.testing.assert_allclose(found, expected, atol=1e-8)
    assert np.abs(expected).max() > 1e-5


def test_a_stiff_controller_of_limited_efforts_has_an_equilibrium():
    scene = scenes.fig7()
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


@each_topology
def test_equilibria_are_where_the_efforts_hold_the_arm(topology):
    linkage, q, *_ = motion(topology)
    tau = fj.analysis.holding_efforts(linkage, q)
    qdd = fj.forward_dynamics(linkage, q, STILL, tau)
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
def test_masses_of_elements_are_held_too():
    linkage, q, *_ = motion("PR")
    load = TipLoad()
    controller = held(linkage, q, [300.0, 200.0], np.ones(2), (load,))
    found = fj.analysis.equilibrium(linkage, q + 0.05, (controller, load))
    np.testing.assert_allclose(found, q, atol=1e-8)


@pytest.mark.parametrize("share, found", [(0.95, True), (1.05, False)])
def test_loads_that_nothing_holds_have_no_equilibrium(share, found):
    """A shoulder motor can be too weak or too strong for every posture."""
    tau = share * fj.analysis.holding_efforts(ROD, STILL)
    q = fj.analysis.equilibrium(ROD, [0.4, 0.1, -0.1], (fj.JointEffort(tau),))
    assert np.isfinite(q).all() == found
    if found:
        np.testing.assert_allclose(fj.analysis.holding_efforts(ROD, q), tau, atol=1e-9)


# The regressor


@each_topology
def test_the_regressor_times_the_parameters_is_the_inverse_dynamics(topology):
    linkage, q, qd, qdd = motion(topology)
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
    linkage, *_ = motion("RPR")
    samples = np.random.default_rng(1).uniform(-2, 2, (3, 40, 3))
    stacked = jax.vmap(lambda *row: fj.analysis.regressor(linkage, *row))(*samples)
    matrix = np.asarray(stacked).reshape(120, 12)
    values = np.linalg.svd(matrix, compute_uv=False)
    assert values[8] > 1e-3 * values[0] and values[9] < 1e-12 * values[0]
    np.testing.assert_allclose(matrix[:, 0], 0, atol=1e-12)
    # The parameters found are not unique, but are right for other motions too.
    efforts = jax.vmap(lambda *row: fj.inverse_dynamics(linkage, *row))
    seen = np.asarray(efforts(*samples)).ravel()
    found, *_ = np.linalg.lstsq(matrix[:60], seen[:60], rcond=1e-10)
    np.testing.assert_allclose(matrix[60:] @ found, seen[60:], atol=1e-8)


# Malformed arguments


@pytest.mark.parametrize(
    "element",
    [
        fj.control.FirstOrderLag(fj.JointEffort(np.ones(3)), 0.1),
        fj.simulation.PrescribedMotion(1, Hold(jnp.zeros(3))),
    ],
    ids=["state", "prescribed"],
)
def test_elements_that_are_no_function_of_the_state_are_refused(element):
    state = fj.State(STILL, STILL)
    for call in (
        lambda: fj.linearize(ROD, state, (element,)),
        lambda: fj.analysis.equilibrium(ROD, STILL, (element,)),
        lambda: modes_at(ROD, (element,), (STILL, STILL)),
    ):
        with pytest.raises(ValueError, match="forces: expected elements without"):
            call()
