"""MuJoCo as an independent engine, through the library's own MJCF export."""

import mujoco
import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_accelerations_equal_mujoco(topology):
    rng = np.random.default_rng(fj.TOPOLOGIES.index(topology))
    for _ in range(20):
        linkage = random_linkage(topology, rng)
        q, qd, tau = rng.normal(size=(3, 3)) * [[1], [2], [5]]
        model = mujoco.MjModel.from_xml_string(fj.to_mjcf(linkage))
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.qfrc_applied = q, qd, tau
        mujoco.mj_forward(model, data)
        qdd = np.asarray(fj.forward_dynamics(linkage, q, qd, tau))
        assert np.abs(qdd - data.qacc).max() <= 1e-11 * (1 + np.abs(data.qacc).max())
        tip = data.site("tip").xpos[:2]
        np.testing.assert_allclose(fj.tip_position(linkage, q), tip, atol=1e-13)


def test_massless_tip_is_passed_as_the_smallest_that_mujoco_takes():
    linkage = fj.Linkage(
        "RRR",
        length=[0, 1, 1, 1],
        com=[[0.5, 0]] * 3,
        mass=[1, 1, 0],
        inertia=[0.1, 0.1, 0.1],
    )
    model = mujoco.MjModel.from_xml_string(fj.to_mjcf(linkage))
    assert model.body("link3").mass == 1e-15
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    qdd = fj.forward_dynamics(linkage, [0, 0, 0], [0, 0, 0], [0, 0, 0])
    np.testing.assert_allclose(qdd, data.qacc, rtol=1e-11, atol=1e-11)


def test_energy_equals_mujoco():
    rng = np.random.default_rng(0)
    for topology in fj.TOPOLOGIES:
        linkage = random_linkage(topology, rng)
        q, qd = rng.normal(size=(2, 3))
        model = mujoco.MjModel.from_xml_string(fj.to_mjcf(linkage))
        model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        data = mujoco.MjData(model)
        data.qpos, data.qvel = q, qd
        mujoco.mj_forward(model, data)
        kinetic, potential = fj.energy(linkage, q, qd)
        np.testing.assert_allclose(
            [potential, kinetic], data.energy, rtol=1e-12, atol=1e-12
        )


def test_batched_linkage_is_refused():
    import jax

    linkage = random_linkage("RRR", np.random.default_rng(0))
    batch = jax.tree.map(lambda a: np.stack([a, a]), linkage)
    with pytest.raises(ValueError, match="linkage"):
        fj.to_mjcf(batch)
