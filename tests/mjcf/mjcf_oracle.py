"""MuJoCo's own accelerations and motions, compared with those of arms read from it."""

import copy
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

import fdof_jax as fj

# MuJoCo has other models of these, which the comparisons leave out on both sides.
APPROXIMATE = (fj.forces.JointStops, fj.forces.JointFriction)
SLIDE, HINGE = 2, 3  # MuJoCo's mjtJoint


class Arm(NamedTuple):
    """Where the arm's joints are in MuJoCo's arrays, in order."""

    joints: np.ndarray
    qpos: np.ndarray
    dofs: np.ndarray
    sign: np.ndarray  # q = sign * qpos, qd = sign * qvel, tau = sign * qfrc


def arm_of(model):
    """Finds the arm: of the trees of hinges and slides, that of the most joints.

    Hinges count more, so that an arm of one hinge goes before a target on two slides.
    """
    trees = {}
    for joint in range(model.njnt):
        tree = int(model.dof_treeid[model.jnt_dofadr[joint]])
        trees.setdefault(tree, []).append(joint)
    kinds = lambda joints: [int(model.jnt_type[k]) for k in joints]
    planar = [joints for joints in trees.values() if {*kinds(joints)} <= {SLIDE, HINGE}]
    count = lambda joints: (kinds(joints).count(HINGE), len(joints))
    joints = np.array(max(planar, key=count))
    data = at_start(model)
    mujoco.mj_forward(model, data)
    hinges = model.jnt_type[joints] == HINGE
    sign = np.ones(len(joints))
    if hinges.any():
        axes = data.xaxis[joints]
        sign[hinges] = np.sign(axes[hinges] @ axes[hinges][0])
    return Arm(joints, model.jnt_qposadr[joints], model.jnt_dofadr[joints], sign)


def at_start(model):
    """Returns data in the first key frame, if there is one, else at qpos0."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    return data


def dropped(model, drop=()):
    """Returns a copy without what `drop` names, and without what is approximate."""
    model = copy.copy(model)
    bits = mujoco.mjtDisableBit
    flags = bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_LIMIT | bits.mjDSBL_CONTACT
    if "actuators" in drop:
        flags |= bits.mjDSBL_ACTUATION
    if "equalities" in drop:
        flags |= bits.mjDSBL_EQUALITY
    model.opt.disableflags |= int(flags)
    model.dof_frictionloss[:] = model.tendon_frictionloss[:] = 0
    model.opt.density = model.opt.viscosity = 0
    if "springs" in drop:
        model.jnt_stiffness[:] = 0
    if "tendons" in drop:
        model.tendon_stiffness[:] = model.tendon_damping[:] = 0
    return model


def random_controls(model, rng):
    """Returns controls within their ranges, (nu,)."""
    low, high = model.actuator_ctrlrange.T
    limited = rng.uniform(np.minimum(low, high), np.maximum(low, high))
    return np.where(model.actuator_ctrllimited, limited, rng.normal(size=model.nu))


def random_places(model, arm, rng):
    """Returns positions of the arm's joints within their ranges, in MuJoCo's sense."""
    spread = np.where(model.jnt_type[arm.joints] == HINGE, 1.2, 0.4)
    places = model.qpos0[arm.qpos] + rng.normal(size=len(arm.joints)) * spread
    low, high = model.jnt_range[arm.joints].T
    inside = np.clip(places, low + 0.01 * (high - low), high - 0.01 * (high - low))
    return np.where(model.jnt_limited[arm.joints], inside, places)


def exact(forces):
    """Returns the elements that are not approximate."""
    return tuple(force for force in forces if not isinstance(force, APPROXIMATE))


def accelerations(linkage, forces, q, qd):
    """Computes accelerations at time 0 in many states, (states, n)."""
    inertial = tuple(f for f in forces if isinstance(f, fj.forces.InertialElement))

    def at_once(q, qd):
        tau = np.zeros(q.shape)
        for force in forces:
            state = force.initial_state(linkage)
            tau = tau + force.act(0.0, q, qd, linkage, state)[0]
        return fj.forward_dynamics(linkage, q, qd, tau, inertial)

    return np.asarray(jax.vmap(at_once)(q, qd))


def compare(model, read: Any, rng, states=20, drop=()):
    """Returns the greatest error of accelerations, |qdd - qacc| / (1 + max|qacc|).

    Half of the states have the controls of the key frame or 0, half have random ones.
    Stateful actuators stay in their state at the start.

    **Arguments:** `model`: MuJoCo's; `read`: a function that returns the `MjcfModel`
    for controls, (nu,), or for None; `drop`: what was left out on purpose.
    """
    model, errors = dropped(model, drop), []
    model.opt.timestep = 1e-14  # currents and slew rates act at the end of a step
    arm, start = arm_of(model), at_start(model)
    for controls in (None, random_controls(model, rng)):
        mine = read(controls)
        np.testing.assert_allclose(
            [mine.state0.q, mine.state0.qd],
            [arm.sign * start.qpos[arm.qpos], arm.sign * start.qvel[arm.dofs]],
            atol=1e-12,
        )
        places, rates, expected = [], [], []
        for _ in range(states // 2):
            data = at_start(model)
            data.qpos[arm.qpos] = random_places(model, arm, rng)
            data.qvel[arm.dofs] = rng.normal(size=len(arm.dofs))
            if controls is not None:
                data.ctrl[:] = controls
            mujoco.mj_forward(model, data)
            places.append(arm.sign * data.qpos[arm.qpos])
            rates.append(arm.sign * data.qvel[arm.dofs])
            expected.append(arm.sign * data.qacc[arm.dofs])
        qdd = accelerations(
            mine.linkage, exact(mine.forces), *map(np.array, (places, rates))
        )
        expected = np.array(expected)
        size = 1 + np.abs(expected).max(axis=1, keepdims=True)
        errors.append(np.abs((qdd - expected) / size).max())
    return float(max(errors))


def motion_of(model, ts, step):
    """Returns the arm's positions, in its sense, at times after the first."""
    model, arm = copy.copy(model), arm_of(model)
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, step
    data, places = at_start(model), []
    for _ in ts[1:]:
        mujoco.mj_step(model, data, round((ts[1] - ts[0]) / step))
        places.append(arm.sign * data.qpos[arm.qpos])
    return np.array(places)


def compare_motion(model, read, seconds=1.0, drop=()):
    """Returns the greatest error of positions, |q - qpos| / (1 + max|qpos|).

    MuJoCo moves by RK4 with steps of 0.1 ms, with the controls of the key frame or 0.
    Its stateful actuators are of the first order in the step, so that positions are
    extrapolated from these steps and their halves.
    """
    model, mine, ts = dropped(model, drop), read(None), np.linspace(0, seconds, 11)
    coarse, fine = (motion_of(model, ts, step) for step in (1e-4, 5e-5))
    expected = 2 * fine - coarse
    scene = fj.Scene(mine.linkage, mine.state0, exact(mine.forces), seconds)
    q = np.asarray(fj.simulate(scene, ts, rtol=1e-10, atol=1e-11).q)[1:]
    return float(np.abs(q - expected).max() / (1 + np.abs(expected).max()))


def in_mujoco(text):
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    return model, mujoco.MjData(model)


def equal(values, expected, tolerance=1e-10):
    np.testing.assert_allclose(values, expected, rtol=tolerance, atol=tolerance)
