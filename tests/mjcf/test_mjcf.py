"""Arms written as MuJoCo's models, and read back: both engines accelerate alike."""

from itertools import product

import equinox as eqx
import jax
import mujoco
import numpy as np
import pytest
from elements import Hold
from helpers import random_linkage
from mjcf_oracle import equal, in_mujoco

import fdof_jax as fj

# Written


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_accelerations_energies_and_tips_equal_mujoco(topology):
    rng = np.random.default_rng(fj.TOPOLOGIES.index(topology))
    for _ in range(20):
        linkage = random_linkage(topology, rng)
        q, qd, tau = rng.normal(size=(3, 3)) * [[1], [2], [5]]
        model, data = in_mujoco(fj.to_mjcf(linkage))
        data.qpos, data.qvel, data.qfrc_applied = q, qd, tau
        mujoco.mj_forward(model, data)
        qdd = np.asarray(fj.forward_dynamics(linkage, q, qd, tau))
        assert np.abs(qdd - data.qacc).max() <= 1e-11 * (1 + np.abs(data.qacc).max())
        equal(fj.tip_position(linkage, q), data.site("tip").xpos[:2], 1e-13)
        equal(fj.energy(linkage, q, qd)[::-1], data.energy, 1e-12)


def test_massless_tip_is_passed_as_the_smallest_that_mujoco_takes():
    linkage = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 0],
        inertia=[0.1, 0.1, 0.1],
    )  # fmt: skip
    text = fj.to_mjcf(linkage)
    assert "tendon" not in text  # there is no spring
    model, data = in_mujoco(text)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.timestep == 1e-3
    assert model.body("link3").mass == 1e-15
    mujoco.mj_forward(model, data)
    equal(fj.forward_dynamics(linkage, *np.zeros((3, 3))), data.qacc, 1e-11)


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
        model, data = in_mujoco(fj.to_mjcf(linkage, forces))
        for _ in range(5):
            q, qd = rng.normal(size=(2, 3))
            mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
            data.qpos, data.qvel = q, qd
            mujoco.mj_forward(model, data)
            tau = sum(force(0.0, q, qd, linkage) for force in forces)
            qdd = fj.forward_dynamics(linkage, q, qd, tau, (armature,))
            equal(qdd, data.qacc)
    # Stops and friction are MuJoCo's own.
    stops = fj.forces.JointStops([-1, 0, -np.inf], [1, np.inf, np.inf])
    friction = fj.forces.JointFriction([1, 2, 3])
    model, _ = in_mujoco(fj.to_mjcf(linkage, (stops, friction)))
    assert model.jnt_limited.tolist() == [1, 1, 0]
    assert model.jnt_range[0].tolist() == [-1, 1]
    assert model.dof_frictionloss.tolist() == [1, 2, 3]


@pytest.mark.slow
def test_exported_motion_equals_mujoco():
    scene = fj.scenes.fig7()
    pd = eqx.tree_at(lambda pd: pd.reference, scene.forces[0], Hold(scene.state0.q + 1))
    spring = fj.SpringDamper(
        fj.Point(0, 0.3, -0.9), fj.Point(2, 0.2), stiffness=30, rest_length=0.4
    )
    forces = (fj.JointDamper(1.0), fj.forces.Armature(0.1), spring, pd)
    scene, ts = scene._replace(forces=forces), np.linspace(0, 2, 21)
    motion = fj.simulate(scene, ts, rtol=1e-11, atol=1e-12)
    efforts = fj.joint_efforts(scene, motion).elements[3]
    assert (np.abs(efforts) >= np.asarray(pd.limit)).any()
    model, data = in_mujoco(fj.to_mjcf(scene.linkage, forces))
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 2e-5
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos, data.qvel = scene.state0
    for expected in np.asarray(motion.q)[1:]:
        mujoco.mj_step(model, data, 5000)
        np.testing.assert_allclose(data.qpos, expected, atol=1e-6)


# Both ways


@eqx.filter_jit  # arms of one size share a program
def accelerations(linkage, forces, q, qd):
    states = [force.initial_state(linkage) for force in forces]
    acting = [f.act(0.0, q, qd, linkage, s)[0] for f, s in zip(forces, states)]
    inertial = tuple(f for f in forces if isinstance(f, fj.forces.InertialElement))
    return fj.forward_dynamics(linkage, q, qd, sum(acting), inertial)


def everything(rng, n, servo):
    """Returns one of each element that both engines have, for n joints."""
    positive = lambda: rng.uniform(0.1, 2, size=n)
    points = fj.Point(0, 0.3, -0.9), fj.Point(n, 0.2, 0.1)
    spring = lambda **rest: fj.SpringDamper(*points, stiffness=3.0, **rest)
    parts = [
        fj.JointDamper(positive()),
        fj.forces.Armature(positive()),
        fj.forces.JointSpring(positive(), rng.normal(size=n)),
        fj.forces.JointStops(np.full(n, -50.5), np.full(n, 60.5)),
        fj.forces.JointFriction(positive()),
        spring(damping=0.3, rest_length=0.4),
        spring(rest_length=0.4, one_sided="cable"),
        spring(rest_length=5.0, one_sided="bumper"),
    ]
    if servo:
        limit = np.where(rng.random(n) < 0.5, np.inf, positive())
        point = fj.references.SetPoint(*rng.normal(size=(2, n)))
        return parts + [fj.PDController(positive(), positive(), limit, point)]
    gear, (gain, bias) = rng.normal(size=(3, n)), rng.normal(size=(2, 3, 3))
    gain[1:] = 0  # those with states
    states = fj.control.Activation(
        [1.5, 2, 3], [[0] * 4, [1, 0, 0, 0], [5, -5, 0, 0]], [0.4, 0.3, 0.1],
        lower=[-np.inf, -1, -np.inf], upper=[np.inf, 1, np.inf],
    )  # fmt: skip
    limits = dict(lower=[-1, -np.inf, -np.inf], upper=[0.5, np.inf, 0.8])
    actuators = fj.control.Actuators(
        gear, gain, bias, rng.normal(size=3), **limits, activation=states
    )
    return [*parts, actuators, fj.JointEffort(rng.normal(size=n))]


def back_and_forth(seed, n, servo):
    rng = np.random.default_rng(seed)
    kinds = "".join(rng.choice(list("RRRPPF"), size=n - 1)) + "R"
    arm, moves = random_linkage(kinds, rng), np.array(list(kinds)) != "F"
    forces = tuple(everything(rng, n, servo))
    start = fj.State(*rng.normal(size=(2, n)))
    again = fj.from_mjcf(fj.to_mjcf(arm, forces, start))
    equal(again.state0, np.array(start)[:, moves], 1e-15)
    for q, qd in rng.normal(size=(2, 2, n)) * moves:
        expected = accelerations(arm, forces, q, qd)[moves]
        ours = accelerations(again.linkage, again.forces, q[moves], qd[moves])
        size = 1 + abs(expected).max()
        equal(ours / size, expected / size, 1e-12)
        tips = fj.tip_position(arm, q), fj.tip_position(again.linkage, q[moves])
        equal(*tips, 1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_what_is_written_is_read(seed):
    back_and_forth(seed, n=3, servo=seed % 2)


@pytest.mark.slow
def test_what_is_written_of_arms_of_one_to_four_pairs_is_read():
    for seed in range(2, 10):  # arms of more joints take programs of their own
        n, servo = [(1, 0), (2, 1), (3, 0), (4, 1)][seed % 4]
        back_and_forth(seed, n, servo)


def test_a_scene_is_written_whole():
    scene = fj.scenes.fig7()
    again = fj.from_mjcf(fj.to_mjcf(scene))
    (pd,), (expected,) = again.forces, scene.forces
    equal(again.state0, scene.state0)
    for name in ("kp", "kd", "limit"):
        equal(getattr(pd, name), getattr(expected, name))
    start = lambda pd: pd.schedule(np.zeros(()), scene.linkage)
    equal(np.array(start(pd)), np.array(start(expected)))


def test_arms_with_fixed_pairs_come_back_as_they_were():
    rng = np.random.default_rng(1)
    q, qd, tau = rng.normal(size=(3, 3))
    for kinds in product("RPF", repeat=3):
        if "R" not in kinds:
            continue
        arm, moves = random_linkage("".join(kinds), rng), np.array(kinds) != "F"
        again = fj.from_mjcf(fj.to_mjcf(arm)).linkage
        equal(fj.tip_position(again, q[moves]), fj.tip_position(arm, q), 1e-12)
        qdd = fj.forward_dynamics(again, q[moves], qd[moves], tau[moves])
        equal(qdd, fj.forward_dynamics(arm, q, qd, tau)[moves], 1e-9)


def test_limits_of_one_joint_leave_others_free():
    """A limited joint beside a motor; gains of 0; both come back."""
    arm = random_linkage("RRR", np.random.default_rng(0))
    point = fj.references.SetPoint([0.1, 0.2, 0.3])
    pd = fj.PDController([5.0, 0, 0], [0, 2.0, 0], [3, 2, 1], point)
    again = fj.from_mjcf(fj.to_mjcf(arm, (pd, fj.JointEffort([0, 0, 4.0]))))
    servo, motor = again.forces
    equal((servo.kp, servo.kd, servo.limit), (pd.kp, pd.kd, [3, 2, np.inf]))
    equal(motor.tau, [0, 0, 4])
    with pytest.raises(ValueError, match="forces.0.: expected no limit of efforts"):
        fj.to_mjcf(arm, (pd, fj.JointEffort(1.0)))
