"""A scene as a term of diffrax: its motion, its events, and noise on the efforts."""

import diffrax
import elements
import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
import pytest

import fdof_jax as fj

CONTROL = diffrax.PIDController(rtol=1e-10, atol=1e-10)


def end_of(scene, **options):
    """Returns the state at the end of a scene, by diffrax alone."""
    term, y0, args = fj.simulation.ode_term(scene)
    options |= dict(stepsize_controller=CONTROL)
    run = term, diffrax.Dopri8(), 0, scene.t1, 1e-3, y0, args
    return jax.tree.map(lambda row: row[-1], diffrax.diffeqsolve(*run, **options).ys)


def compare(found, motion, **bounds):
    (q, qd, own), states = found, jax.tree.leaves(motion.own)
    np.testing.assert_allclose(q, motion.q[-1], atol=1e-8)
    np.testing.assert_allclose(qd, motion.qd[-1], atol=1e-7)
    last = [[], *(np.ravel(rows[-1]) for rows in states)]
    np.testing.assert_allclose(own, np.concatenate(last), **bounds)


def test_diffrax_moves_all_topologies_as_simulate_does_in_one_program():
    traces = []

    @jax.jit
    def end(scene):
        traces.append(scene)
        return end_of(scene)

    for topology in fj.TOPOLOGIES:
        forces = elements.ALL["PD"], elements.ALL["PID"]
        scene = fj.Scene(elements.arm(topology), elements.START, forces, 0.5)
        compare(end(scene), fj.simulate(scene, [0, 0.5]), atol=1e-8)
    assert len(traces) == 1


@pytest.mark.slow
def test_diffrax_moves_all_elements_as_simulate_does():
    forces = tuple(elements.ALL.values())
    scene = fj.Scene(elements.arm("RPR"), elements.START, forces, 0.3)
    compare(end_of(scene), fj.simulate(scene, [0, 0.3]), atol=1e-7)


@pytest.mark.slow
def test_an_event_of_diffrax_ends_a_motion():
    """A uniform bar falls from level at rest: at the bottom its rate is known."""
    scene = fj.Scene(elements.BAR, fj.State([0.0], [0.0]), (), 5.0)
    term, y0, args = fj.simulation.ode_term(scene)
    bottom = diffrax.Event(
        lambda t, y, args, **_: y[0][0] + np.pi / 2, optimistix.Newton(1e-10, 1e-10)
    )
    fall = diffrax.diffeqsolve(
        term, diffrax.Dopri8(), 0, 5.0, 1e-3, y0, args,
        stepsize_controller=CONTROL, event=bottom,
    )  # fmt: skip
    assert fall.result == diffrax.RESULTS.event_occurred
    np.testing.assert_allclose(fall.ys[1][-1], [-np.sqrt(3 * 9.81)], rtol=1e-6)


@pytest.mark.slow
def test_white_torque_has_the_stationary_variance_of_a_damped_bar():
    """It is sigma^2 / (2 d k) of a bar with torsional spring k and damping d."""
    inertia, stiffness, damping, sigma = 1 / 3, 2.0, 0.8, 0.3
    bar = elements.BAR.replace(gravity=0.0)
    forces = fj.forces.JointSpring(stiffness), fj.JointDamper(damping)
    scene = fj.Scene(bar, fj.State([0.0], [0.0]), forces, 8.0)
    drift, y0, args = fj.simulation.ode_term(scene)
    assert float(fj.mass_matrix(bar, y0[0])[0, 0]) == pytest.approx(inertia)

    def noise(t, y, args):
        q, qd, own = y
        rates = jnp.linalg.solve(fj.mass_matrix(bar, q), sigma * jnp.eye(1))
        columns = jnp.zeros((1, 1)), rates, jnp.zeros((own.size, 1))
        return lineax.PyTreeLinearOperator(columns, jax.eval_shape(lambda: y))

    def end(key):
        path = diffrax.VirtualBrownianTree(0.0, 8.0, 5e-3, (1,), key)
        terms = diffrax.MultiTerm(drift, diffrax.ControlTerm(noise, path))
        ends = diffrax.diffeqsolve(terms, diffrax.Heun(), 0, 8.0, 0.02, y0, args).ys
        return ends[0][-1, 0]

    ends = jax.jit(jax.vmap(end))(jax.random.split(jax.random.key(0), 1000))
    right = sigma**2 / (2 * damping * stiffness)
    standard_error = right * np.sqrt(2 / len(ends))
    assert abs(np.var(ends) - right) < 3 * standard_error


def test_only_a_scene_is_accepted():
    with pytest.raises(ValueError, match="scene: expected"):
        fj.simulation.ode_term(elements.arm("RRR"))
