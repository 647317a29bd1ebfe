"""MuJoCo's own accelerations, compared with those of arms read from its models."""

import copy

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np

import fdof_jax as fj

# MuJoCo has other models of these, which the comparisons leave out on both sides.
APPROXIMATE = fj.forces.JointStops, fj.forces.JointFriction
SLIDE, HINGE = 2, 3  # MuJoCo's mjtJoint


def in_mujoco(source):
    """Returns MuJoCo's model of a text or a file, and its data."""
    kind = mujoco.MjModel
    read = kind.from_xml_string if "<" in str(source) else kind.from_xml_path
    model = read(str(source))
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    return model, at_start(model)


def at_start(model):
    """Returns data in the first key frame, if there is one, else at qpos0."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    return data


def joints_of_arm(model):
    """Returns the arm's joints, and their signs: q = sign * qpos.

    Of the trees of hinges and slides it is that of most hinges, then of most joints.
    """
    trees, hinges = model.dof_treeid[model.jnt_dofadr], model.jnt_type == HINGE
    planar = lambda tree: (model.jnt_type[trees == tree] >= SLIDE).all()
    count = lambda tree: (hinges[trees == tree].sum(), (trees == tree).sum())
    arm = max(filter(planar, np.unique(trees)), key=count)
    joints, data = np.flatnonzero(trees == arm), at_start(model)
    mujoco.mj_forward(model, data)
    axes, hinges = data.xaxis[joints], hinges[joints]
    return joints, np.where(hinges, np.sign(axes @ axes[np.argmax(hinges)]), 1)


def comparable(model, drop):
    """Returns a copy without what `drop` names, and without what is approximate."""
    model, bits = copy.copy(model), mujoco.mjtDisableBit
    off = bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_LIMIT | bits.mjDSBL_CONTACT
    off |= bits.mjDSBL_ACTUATION if "actuators" in drop else 0
    off |= bits.mjDSBL_EQUALITY if "equalities" in drop else 0
    off |= bits.mjDSBL_SPRING if "springs" in drop else 0
    model.opt.disableflags |= int(off)
    model.dof_frictionloss[:] = model.tendon_frictionloss[:] = 0
    model.opt.density = model.opt.viscosity = 0
    if "tendons" in drop:
        model.tendon_stiffness[:] = model.tendon_damping[:] = 0
    model.opt.timestep = 1e-14  # currents and slew rates act at the end of a step
    return model


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, None, 0, 0, 0))
def rates(linkage, forces, q, qd, own):
    """Returns accelerations, and rates of the actuators' states, at time 0.

    The states are those at the start, if `own` is None.
    """
    tau, growth = jnp.zeros_like(q), ()
    for force in forces:
        state = force.initial_state(linkage)
        if has_state := np.size(state) > 0:
            state = state if own is None else own
        effort, rate = force.act(0.0, q, qd, linkage, state)
        tau, growth = tau + effort, rate if has_state else growth
    inertial = tuple(f for f in forces if isinstance(f, fj.forces.InertialElement))
    return fj.forward_dynamics(linkage, q, qd, tau, inertial), growth


def error_of(source, drop):
    """Returns the greatest error of accelerations and rates, relative to the largest.

    It is that of a few random states under random controls.
    """
    rng, model = np.random.default_rng(0), comparable(in_mujoco(source)[0], drop)
    (low, high), limited = model.actuator_ctrlrange.T, model.actuator_ctrllimited
    controls = np.where(limited, rng.uniform(low, high), rng.normal(size=model.nu))
    mine = fj.from_mjcf(source, controls=controls, drop=drop)
    joints, signs = joints_of_arm(model)
    places, speeds = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    start, acts = at_start(model), np.flatnonzero(model.actuator_actadr >= 0)
    equal(mine.state0, signs * [start.qpos[places], start.qvel[speeds]], 1e-12)
    if acts.size:
        states = [np.asarray(f.initial_state(mine.linkage)) for f in mine.forces]
        (state,) = (each for each in states if each.size)
        equal(state[acts], start.act)
    spread, rows = np.where(model.jnt_type[joints] == HINGE, 1.2, 0.4), []
    for _ in range(3):
        data = at_start(model)
        moved = rng.normal(size=len(joints)) * spread
        data.qpos[places] = model.qpos0[places] + moved
        data.qvel[speeds] = rng.normal(size=len(joints))
        data.act[:] = rng.uniform(-0.2, 0.2, size=model.na)  # within all limits
        data.ctrl[:] = controls
        mujoco.mj_forward(model, data)
        own, growth = np.zeros((2, len(model.actuator_trntype)))
        own[acts], growth[acts] = data.act, data.act_dot
        arrays = data.qpos[places], data.qvel[speeds], data.qacc[speeds]
        rows.append([*(signs * array for array in arrays), own, growth])
    q, qd, qdd, own, growth = map(np.array, zip(*rows))
    forces = tuple(f for f in mine.forces if not isinstance(f, APPROXIMATE))
    pairs = zip(rates(mine.linkage, forces, q, qd, own), (qdd, growth))
    error = lambda ours, theirs: (
        np.abs(ours - theirs).max() / (1 + np.abs(theirs).max())
    )
    return max(error(*pair) for pair in pairs if np.size(pair[0]))


def equal(values, expected, tolerance=1e-10):
    np.testing.assert_allclose(values, expected, rtol=tolerance, atol=tolerance)
