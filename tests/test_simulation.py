"""Simulation: the paper's figures, order of convergence, motions in phases."""

import diffrax
import jax
import numpy as np
import pytest
from elements import BAR
from helpers import REFERENCE, SCENES, load

import fdof_jax as fj
from fdof_jax import scenes


def along(function, linkage, solution):
    over_time = jax.vmap(function, in_axes=(None, 0, 0))
    return map(np.asarray, over_time(linkage, solution.q, solution.qd))


def test_fig3_comes_to_rest_under_the_pivot():
    scene = scenes.fig3()
    motion = fj.simulate(scene.linkage, scene.state0, [0, 100], scene.forces)
    x, _ = along(fj.paper.to_chain, scene.linkage, motion)
    angles = np.degrees(x[1, 1::2])
    np.testing.assert_allclose(angles, [-47.72631099390626, -135, -45], atol=1e-6)
    centres = np.asarray(fj.mass_centers(scene.linkage, motion.q[-1]))
    centre = np.average(centres, axis=0, weights=scene.linkage.mass)
    np.testing.assert_allclose(centre, [0, -1.4594593826], atol=1e-9)


def test_fig5_conserves_its_energy_and_passes_it_between_links():
    scene, ts = scenes.fig5(), np.linspace(0, 10, 501)
    motion = fj.simulate(scene.linkage, scene.state0, ts)
    kinetic, potential = along(fj.link_energies, scene.linkage, motion)
    assert np.abs((kinetic + potential).sum(axis=1)).max() <= 1e-8
    for row in REFERENCE["chaos"]["rows"]:
        if row["t"] <= 5:
            total = kinetic[round(50 * row["t"])].sum()
            assert total == pytest.approx(row["T"], abs=1e-7)
    tables = {
        25: ([2.298234459, 12.82117469, 16.15041155],
             [-7.712524545, -11.54151306, -12.01578309]),
        75: ([2.147291502, 3.735135913, 4.36871562],
              [-0.4291427303, -2.557089816, -7.264910488]),
        250: ([0.5977764945, 5.901081903, 6.10505396],
              [-2.283401632, -7.598600676, -2.721910049]),
    }  # fmt: skip
    for index, (t, v) in tables.items():
        np.testing.assert_allclose(kinetic[index], t, rtol=3e-9, atol=3e-8)
        np.testing.assert_allclose(potential[index], v, rtol=3e-9, atol=3e-8)


@pytest.mark.parametrize("name", ["fig3", "fig5", "fig7-free"])
def test_default_accuracy(name):
    """Uses the default solver and tolerance, at times between the steps."""
    states, r = SCENES[name]["states"], load(name)
    ts = [0, *(state["t"] for state in states)]
    solution = fj.simulate(r.linkage, r.state0, ts, r.forces)
    x, _ = along(fj.paper.to_chain, r.linkage, solution)
    for state, coordinates in zip(states, x[1:]):
        np.testing.assert_allclose(coordinates, state["q"], rtol=0, atol=1e-8)


def test_fig7_tracks_its_circle():
    scene = scenes.fig7()
    ts = np.concatenate([[0, 0.5, 2], np.arange(500, 1000) * 0.01])
    solution = fj.simulate(scene.linkage, scene.state0, ts, scene.forces)
    task = scene.forces[0].reference
    tips = jax.vmap(fj.tip_position, in_axes=(None, 0))(scene.linkage, solution.q)
    error = np.linalg.norm(tips - jax.vmap(task.tip)(ts), axis=1)
    assert error[0] == pytest.approx(0.25, abs=1e-12)
    assert error[1] == pytest.approx(0.409612, abs=1e-5)
    assert error[2] == pytest.approx(0.179893, abs=1e-5)
    assert np.sqrt(np.mean(error[3:] ** 2)) == pytest.approx(0.253504, abs=1e-5)
    # States of physics at t = 2: th2, B2, th4.
    th2, B2, th4 = solution.q[2] + np.array([0, 0, solution.q[2, 0] + np.pi / 2])
    right = [1.75072080229, 0.790467088356, 1.61872366706]
    np.testing.assert_allclose([th2, B2, th4], right, atol=1e-8)
    efforts = fj.joint_efforts(scene.linkage, scene.forces, solution)
    np.testing.assert_allclose(efforts.total[0], [15.873, -300, -9.921], rtol=1e-4)
    np.testing.assert_array_equal(efforts.total, efforts.elements[0])


@pytest.mark.parametrize(
    "solver, order, steps",
    [
        (diffrax.Bosh3(), 3, [0.01, 0.005, 0.0025]),
        (diffrax.Dopri8(), 8, [0.05, 0.04, 0.025]),
    ],
)
def test_order_of_convergence(solver, order, steps):
    arm, state = scenes.fig5().linkage, fj.State([-1.0, 0.4, 0.3], [0.0, 0.0, 0.0])
    options = dict(solver=solver, stepsize_controller=diffrax.ConstantStepSize())
    end = lambda dt0: fj.simulate(arm, state, [0, 1.0], dt0=dt0, **options).q[-1]
    exact = end(2e-4)
    errors = [float(np.abs(end(h) - exact).max()) for h in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.5)


def test_one_time_gives_the_start():
    scene = scenes.fig5()
    solution = fj.simulate(scene.linkage, fj.State([1, 2, 3], [0, 0, 0]), [2.0])
    np.testing.assert_array_equal(solution.q, [[1, 2, 3]])


# Motions that go on from where another one ended


@pytest.mark.slow
def test_two_phases_are_the_whole_motion():
    """Of an element with a state, and of blows that take energy."""
    pid = fj.control.PIDController(9.0, 5.0, 0.5, 6.0, fj.references.SetPoint(0.5))
    forces = pid, fj.forces.HardStops(-1.7, 0.4, restitution=0.5)
    start, ts = fj.State([-0.5], [0.0]), np.linspace(0, 4, 81)
    whole = fj.simulate(BAR, start, ts, forces)
    first = fj.simulate(BAR, start, ts[:31], forces)
    there = fj.State(first.q[-1], first.qd[-1])
    own = jax.tree.map(lambda rows: rows[-1], first.own)
    second = fj.simulate(BAR, there, ts[30:], forces, own0=own)
    for name in ("ts", "q", "qd", "own", "modes"):
        rows = [getattr(motion, name) for motion in (first, second, whole)]
        for a, b, every in zip(*map(jax.tree.leaves, rows), strict=True):
            joined = np.concatenate([a[:-1], b])
            np.testing.assert_allclose(joined, every, atol=1e-8)
    taken = np.append(first.taken[:-1], first.taken[-1] + second.taken)
    np.testing.assert_allclose(taken, whole.taken, atol=1e-8)
    tables = [motion.events.table for motion in (first, second, whole)]
    for name in ("t [s]", "joint"):
        *parts, wanted = [table[name] for table in tables]
        np.testing.assert_allclose(np.concatenate(parts), wanted, atol=1e-8)
    assert len(tables[0]["event"]) > 0 and len(tables[2]["event"]) > 2


@pytest.mark.slow
@pytest.mark.parametrize("away", [-3, -1, 0, 1, 2, 3, 9])
def test_a_payload_is_taken_once_where_phases_meet(away):
    """In units of rounding from there."""
    bar = BAR.replace(gravity=0.0)
    begin = 0.3 + away * np.spacing(0.3)
    load = fj.forces.Payload(fj.Point(1, along=1), 1.5, begin=begin)
    first = fj.simulate(bar, fj.State([0.0], [2.0]), [0, 0.3], (load,))
    there = fj.State(first.q[-1], first.qd[-1])
    second = fj.simulate(bar, there, [0.3, 1.0], (load,))
    np.testing.assert_allclose(second.qd[-1], 4 / 11, rtol=1e-9)
    taken = first.taken[-1] + second.taken[-1]
    np.testing.assert_allclose(taken, 6 / 11, rtol=1e-9)
