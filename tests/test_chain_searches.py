"""Searches on chains of two pairs: gains and parameters."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj

pytestmark = pytest.mark.slow


def test_tuning_halves_the_tip_error_of_two_links():
    scene = fj.scenes.two_link_circle()
    result = fj.tune(scene)
    first, last = result.histories[0].tip_error[[0, -1]]
    assert result.converged
    assert last < first / 2
    (tuned,) = result.scene.forces
    assert tuned.kp.shape == tuned.kd.shape == (2,)
    assert result.table["joint"] == ["R1", "R2"] * 2
    assert len(str(result).splitlines()) == 10


def test_gains_of_a_fixed_pair_do_not_matter_to_tuning():
    arm, start, (control,), _ = fj.scenes.two_link_circle()
    bent = fj.Linkage(
        "RFR",
        length=[0, 0.5, 0.5, 0.8],
        com=[[0.25, 0], [0.25, 0], [0.4, 0]],
        mass=[1, 1, 1],
        inertia=[1 / 48, 1 / 48, 0.8**2 / 12],
        gravity=0,
    )
    q = fj.inverse_kinematics(bent, [1.1, 0], None)
    control = fj.PDController(100, 10, [60, 1, 30], control.reference)
    scene = fj.Scene(bent, fj.State(q, np.zeros(3)), (control,), 1.0)
    result = fj.tune(scene, max_steps=5)
    same = arm, fj.State(start.q, start.qd), fj.scenes.two_link_circle().forces, 1.0
    expected = fj.tune(fj.Scene(*same), max_steps=5)
    assert result.tip_error == pytest.approx(expected.tip_error, rel=1e-3)
    np.testing.assert_allclose(result.gains[:, [0, 2]], expected.gains, rtol=0.02)
    assert "F2" in str(result)


def test_masses_of_a_double_pendulum_are_found_from_its_motion():
    scene = fj.scenes.double_pendulum()

    def scene_at(parameters):
        arm = eqx.tree_at(lambda arm: arm.mass, scene.linkage, parameters["mass"])
        # Of gravity alone, motions have no scale of mass.
        return scene._replace(linkage=arm, forces=(fj.JointDamper(0.3),))

    ts = np.linspace(0, 2, 41)
    true = {"mass": jnp.array([1.3, 0.7])}
    arm, start, forces, _ = scene_at(true)
    motion = fj.simulate(arm, start, ts, forces)
    seen = fj.identification.link_ends(scene, motion)
    result = fj.fit(scene_at, {"mass": [1.0, 1.0]}, ts, seen)
    np.testing.assert_allclose(result.parameters["mass"], true["mass"], rtol=1e-6)
