"""Simulation: the paper's figures, order of convergence, and endings of solves."""

import diffrax
import jax
import numpy as np
import pytest
from helpers import SCENES, load

import fdof_jax as fj
from fdof_jax import scenes


def absolute_angles(linkage, solution):
    chain = jax.vmap(fj.paper.to_chain, in_axes=(None, 0, 0))
    return np.asarray(chain(linkage, solution.q, solution.qd)[0])[:, 1::2]


def energies(linkage, solution):
    over_time = jax.vmap(fj.link_energies, in_axes=(None, 0, 0))
    return map(np.asarray, over_time(linkage, solution.q, solution.qd))


def test_fig3_comes_to_rest_under_the_pivot():
    scene = scenes.fig3()
    solution = fj.simulate(scene.linkage, scene.state0, [0, 1, 20, 100], scene.forces)
    angles = np.degrees(absolute_angles(scene.linkage, solution))
    np.testing.assert_allclose(
        angles[1], [-55.609084607282, -83.365485917459, -67.239429526858], atol=1e-6
    )
    np.testing.assert_allclose(
        angles[2], [-47.775941241973, -135.05395438541, -45.113147737179], atol=1e-6
    )
    np.testing.assert_allclose(angles[3], [-47.72631099390626, -135, -45], atol=1e-6)
    centres = np.asarray(fj.mass_centers(scene.linkage, solution.q[-1]))
    masses = np.asarray(scene.linkage.mass)
    x, y = masses @ centres / masses.sum()
    np.testing.assert_allclose([x, y], [0, -1.4594593826], atol=1e-9)


def test_fig5_conserves_its_energy_and_passes_it_between_links():
    scene = scenes.fig5()
    ts = np.linspace(0, 10, 501)
    solution = fj.simulate(scene.linkage, scene.state0, ts)
    kinetic, potential = energies(scene.linkage, solution)
    assert np.abs((kinetic + potential).sum(axis=1)).max() <= 1e-8
    total = kinetic.sum(axis=1)
    assert total[50] == pytest.approx(54.889174791186, abs=1e-8)
    assert total[250] == pytest.approx(12.603912358049, abs=1e-7)
    tables = {
        25: ([2.298234459, 12.82117469, 16.15041155],
             [-7.712524545, -11.54151306, -12.01578309]),
        50: ([1.72060184, 13.9524388, 39.21613415],
              [-9.711132357, -19.38953088, -25.78851156]),
        75: ([2.147291502, 3.735135913, 4.36871562],
              [-0.4291427303, -2.557089816, -7.264910488]),
        150: ([3.073952069, 17.80795955, 14.9894397],
              [-8.636185855, -12.79756002, -14.43760544]),
        100: ([3.418419722, 3.345751526, 1.483116072],
              [-2.415474222, -1.457476221, -4.374336877]),
        250: ([0.5977764945, 5.901081903, 6.10505396],
              [-2.283401632, -7.598600676, -2.721910049]),
    }  # fmt: skip
    for index, (t, v) in tables.items():
        np.testing.assert_allclose(kinetic[index], t, rtol=3e-9, atol=3e-8)
        np.testing.assert_allclose(potential[index], v, rtol=3e-9, atol=3e-8)


@pytest.mark.parametrize("name", ["fig3", "fig5", "fig7-free"])
def test_default_accuracy_to_two_seconds(name):
    """Uses the default solver and tolerance, at times between the steps."""
    states = [state for state in SCENES[name]["states"] if state["t"] <= 2]
    r = load(name)
    ts = [0, *(state["t"] for state in states)]
    solution = fj.simulate(r.linkage, r.state0, ts, r.forces)
    chain = jax.vmap(fj.paper.to_chain, in_axes=(None, 0, 0))
    x, _ = chain(r.linkage, solution.q, solution.qd)
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
    np.testing.assert_allclose(
        [solution.q[2, 0], solution.q[2, 1], solution.q[2].sum()
         - solution.q[2, 1] + np.pi / 2],
        [1.75072080229, 0.790467088356, 1.61872366706],
        atol=1e-8,
    )  # fmt: skip
    efforts = fj.joint_efforts(scene.linkage, scene.forces, solution)
    np.testing.assert_allclose(efforts.total[0], [15.873, -300, -9.921], rtol=1e-4)
    np.testing.assert_array_equal(efforts.total, efforts.elements[0])


@pytest.mark.parametrize(
    ("solver", "order", "steps"),
    [
        (diffrax.Bosh3(), 3, [0.01, 0.005, 0.0025]),
        (diffrax.Dopri8(), 8, [0.05, 0.04, 0.025]),
    ],
)
def test_order_of_convergence(solver, order, steps):
    scene = scenes.fig5()
    state = fj.State([-1.0, 0.4, 0.3], [0.0, 0.0, 0.0])

    def end(dt0):
        return fj.simulate(
            scene.linkage,
            state,
            [0, 1.0],
            (fj.JointDamper(0.0),),  # one program with what follows
            solver=solver,
            stepsize_controller=diffrax.ConstantStepSize(),
            dt0=dt0,
        ).q[-1]

    exact = end(2e-4)
    errors = [float(np.abs(end(h) - exact).max()) for h in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.5)


def test_constant_steps_that_are_too_long_do_not_succeed():
    scene = scenes.fig5()
    stiff = (fj.JointDamper(1e5),)
    keywords = dict(
        solver=diffrax.Dopri8(),
        stepsize_controller=diffrax.ConstantStepSize(),
        dt0=0.01,
    )
    ts = np.linspace(0, 2, 3)
    still = scene.state0._replace(qd=np.ones(3))
    solution = fj.simulate(scene.linkage, still, ts, stiff, throw=False, **keywords)
    assert solution.outcome == "not finite" and np.isnan(solution.q[-1]).all()
    finite = np.isfinite(solution.q).all(axis=1)
    assert solution.stats["time_reached"] == ts[finite][-1]
    with pytest.raises(RuntimeError, match="not finite"):
        fj.simulate(scene.linkage, still, ts, stiff, **keywords)


@pytest.mark.slow
def test_a_force_that_fails_at_the_start_is_named():
    linkage, start, *_ = scenes.fig5()
    few, none = lambda t, q, qd: q, lambda t, q, qd, linkage: q * np.nan
    with pytest.raises(TypeError, match=r"forces\[1\]: .* \(t, q, qd, linkage\)"):
        fj.simulate(linkage, start, [0, 1], (fj.JointDamper(1.0), few))
    with pytest.raises(RuntimeError, match=r"forces\[1\] is not finite at the start"):
        fj.simulate(linkage, start, [0, 1], (fj.JointDamper(1.0), none))


def test_time_need_not_start_at_zero():
    scene = scenes.fig5()
    from_zero = fj.simulate(scene.linkage, scene.state0, [0.0, 1.0])
    later = fj.simulate(scene.linkage, scene.state0, [5.0, 6.0])
    np.testing.assert_allclose(later.q, from_zero.q, atol=1e-9)


def test_one_time_gives_the_start():
    scene = scenes.fig5()
    solution = fj.simulate(scene.linkage, fj.State([1, 2, 3], [0, 0, 0]), [2.0])
    np.testing.assert_array_equal(solution.q, [[1, 2, 3]])
