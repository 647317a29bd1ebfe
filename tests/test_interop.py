"""MuJoCo as an independent engine, through the library's own MJCF export."""

import equinox as eqx
import jax
import mujoco
import numpy as np
import pytest
from elements import Hold
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
    text = fj.to_mjcf(linkage)
    assert "tendon" not in text  # there is no spring
    model = mujoco.MjModel.from_xml_string(text)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.timestep == 1e-3
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
    linkage = random_linkage("RRR", np.random.default_rng(0))
    batch = jax.tree.map(lambda a: np.stack([a, a]), linkage)
    with pytest.raises(ValueError, match="linkage"):
        fj.to_mjcf(batch)


def test_exported_elements_act_as_in_mujoco():
    """Compares accelerations of all elements that both engines model alike."""
    rng = np.random.default_rng(4)
    points = fj.Point(0, 0.3, -0.9), fj.Point(2, 0.2, 0.1)
    hold = Hold(jax.device_put(np.array([0.3, -0.2, 0.5])))
    springs = (
        fj.SpringDamper(*points, stiffness=30, damping=2, rest_length=0.4),
        fj.SpringDamper(*points, stiffness=8, rest_length=0.5, one_sided="cable"),
        fj.SpringDamper(*points, stiffness=9, rest_length=3, one_sided="bumper"),
    )
    armature = fj.forces.Armature([0.3, 0.2, 0.1])
    pd = fj.PDController([9, 7, 5], [3, 2, 1], [4, 0.5, np.inf], hold)
    forces = (fj.JointDamper([0.3, 0.2, 0.1]), armature, *springs, pd)
    for topology in ("RPR", "RRR"):
        linkage = random_linkage(topology, rng)
        model = mujoco.MjModel.from_xml_string(fj.to_mjcf(linkage, forces))
        data = mujoco.MjData(model)
        for _ in range(5):
            q, qd = rng.normal(size=(2, 3))
            mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
            data.qpos, data.qvel = q, qd
            mujoco.mj_forward(model, data)
            tau = sum(force(0.0, q, qd, linkage) for force in forces)
            qdd = fj.forward_dynamics(linkage, q, qd, tau, (armature,))
            np.testing.assert_allclose(qdd, data.qacc, rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_exported_motion_equals_mujoco():
    scene = fj.scenes.fig7()
    pd = eqx.tree_at(lambda pd: pd.reference, scene.forces[0], Hold(scene.state0.q + 1))
    spring = fj.SpringDamper(
        fj.Point(0, 0.3, -0.9), fj.Point(2, 0.2), stiffness=30, rest_length=0.4
    )
    forces = (fj.JointDamper(1.0), fj.forces.Armature(0.1), spring, pd)
    ts = np.linspace(0, 2, 21)
    motion = fj.simulate(
        scene.linkage, scene.state0, ts, forces, rtol=1e-11, atol=1e-12
    )
    efforts = fj.joint_efforts(scene.linkage, forces, motion)[1][3]
    assert (np.abs(efforts) >= np.asarray(pd.limit)).any()
    model = mujoco.MjModel.from_xml_string(fj.to_mjcf(scene.linkage, forces))
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 2e-5
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos, data.qvel = scene.state0
    for expected in np.asarray(motion.q)[1:]:
        mujoco.mj_step(model, data, 5000)
        np.testing.assert_allclose(data.qpos, expected, atol=1e-6)


def test_stops_and_friction_are_mujocos_own():
    linkage = random_linkage("RPR", np.random.default_rng(0))
    stops = fj.forces.JointStops([-1, 0, -np.inf], [1, np.inf, np.inf])
    forces = (stops, fj.forces.JointFriction([1, 2, 3]))
    model = mujoco.MjModel.from_xml_string(fj.to_mjcf(linkage, forces))
    assert model.jnt_limited.tolist() == [1, 1, 0]
    assert model.jnt_range[0].tolist() == [-1, 1]
    assert model.dof_frictionloss.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    "force, got",
    [
        (fj.JointEffort([1, 2, 3]), "got JointEffort"),
        (lambda t, q, qd, linkage: q, "got function"),
        (fj.JointDamper(1.0), "expected one JointDamper"),
        (
            fj.SpringDamper(
                fj.Point(0), fj.Point(1), damping=1, one_sided="cable", rest_length=1
            ),
            "expected no damping of a cable",
        ),
        (fj.SpringDamper(fj.Point(0), fj.Point(5), stiffness=1), "link: expected"),
    ],
)
def test_other_elements_are_refused_by_name(force, got):
    linkage = random_linkage("RRR", np.random.default_rng(0))
    with pytest.raises(ValueError, match=got):
        fj.to_mjcf(linkage, (fj.JointDamper(1.0), force))
