"""Arms written as MuJoCo's models, and read back.

What is read accelerates as in MuJoCo: see test_mjcf_reading.py.
"""

from itertools import product

import mujoco
import numpy as np
import pytest
from helpers import random_linkage
from mjcf_oracle import equal, in_mujoco, rates

import fdof_jax as fj


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_accelerations_energies_and_tips_equal_mujoco(topology):
    rng = np.random.default_rng(fj.TOPOLOGIES.index(topology))
    for _ in range(5):
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
    linkage = random_linkage("RRR", np.random.default_rng(0)).replace(mass=[1, 1, 0])
    model, data = in_mujoco(fj.to_mjcf(linkage))
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.timestep == 1e-3 and model.body("link3").mass == 1e-15
    mujoco.mj_forward(model, data)
    equal(fj.forward_dynamics(linkage, *np.zeros((3, 3))), data.qacc, 1e-11)


def everything(rng, n, servo):
    """Returns one of each element that both engines have, for n joints."""
    positive = lambda: rng.uniform(0.1, 2, size=n)
    points = fj.Point(0, 0.3, -0.9), fj.Point(n, 0.2, 0.1)
    spring = lambda **rest: fj.SpringDamper(*points, stiffness=3.0, **rest)
    ends = np.append(-np.inf, np.full(n - 1, -50.5)), np.full(n, 60.5)
    parts = [
        fj.JointDamper(positive()),
        fj.forces.Armature(positive()),
        fj.forces.JointSpring(positive(), rng.normal(size=n)),
        fj.forces.JointStops(*ends),
        fj.forces.JointFriction(positive()),
        spring(damping=0.3, rest_length=0.4),
        spring(rest_length=0.4, one_sided="cable"),
        spring(rest_length=5.0, one_sided="bumper"),
    ]
    if servo:
        limit = np.where(rng.random(n) < 0.5, np.inf, positive())
        point = fj.references.SetPoint(*rng.normal(size=(2, n)))
        return (*parts, fj.PDController(positive(), positive(), limit, point))
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
    return (*parts, actuators, fj.JointEffort(rng.normal(size=n)))


@pytest.mark.slow
@pytest.mark.parametrize("kinds, servo", [("FR", True), ("RFPR", False)])
def test_what_is_written_is_read(kinds, servo):
    rng, n = np.random.default_rng(0), len(kinds)
    arm, moves = random_linkage(kinds, rng), np.array(list(kinds)) != "F"
    forces, start = everything(rng, n, servo), fj.State(*rng.normal(size=(2, n)))
    again = fj.from_mjcf(fj.to_mjcf(arm, forces, start))
    equal(again.state0, np.array(start)[:, moves], 1e-15)
    (stops,) = (f for f in again.forces if isinstance(f, fj.forces.JointStops))
    for name in ("lower", "upper"):
        equal(getattr(stops, name), getattr(forces[3], name)[moves])
    q, qd = rng.normal(size=(2, 2, n)) * moves
    expected = rates(arm, forces, q, qd, None)[0][:, moves]
    found = rates(again.linkage, again.forces, q[:, moves], qd[:, moves], None)[0]
    equal(found / abs(expected).max(), expected / abs(expected).max(), 1e-12)
    tips = fj.tip_position(arm, q[0]), fj.tip_position(again.linkage, q[0, moves])
    equal(*tips, 1e-12)


def test_a_scene_is_written_whole_and_limits_of_one_joint_leave_others_free():
    """A limited joint beside a motor; gains of 0; both come back."""
    scene = fj.scenes.fig7()
    again = fj.from_mjcf(fj.to_mjcf(scene))
    (pd,), (expected,) = again.forces, scene.forces
    equal(again.state0, scene.state0)
    for name in ("kp", "kd", "limit"):
        equal(getattr(pd, name), getattr(expected, name))
    start = lambda pd: np.array(pd.schedule(np.zeros(()), scene.linkage))
    equal(start(pd), start(expected))
    arm = random_linkage("RRR", np.random.default_rng(0))
    point = fj.references.SetPoint([0.1, 0.2, 0.3])
    pd = fj.PDController([5.0, 0, 0], [0, 2.0, 0], [3, 2, 1], point)
    again = fj.from_mjcf(fj.to_mjcf(arm, (pd, fj.JointEffort([0, 0, 4.0]))))
    servo, motor = again.forces
    equal((servo.kp, servo.kd, servo.limit), (pd.kp, pd.kd, [3, 2, np.inf]))
    equal(motor.tau, [0, 0, 4])
    with pytest.raises(ValueError, match="forces.0.: expected no limit of efforts"):
        fj.to_mjcf(arm, (pd, fj.JointEffort(1.0)))


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
