"""Bearing reactions: balance of each link, MuJoCo, the paper's constraint forces."""

from xml.etree import ElementTree

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from chains import moving
from helpers import random_motion

import fdof_jax as fj
from fdof_jax.linkage.frames import frames

GROUND, TIP = fj.Point(0, 0.3, -0.8), fj.Point(3, 0.5, 0.2)
SPRING = fj.SpringDamper(GROUND, TIP, stiffness=30.0, damping=2.0, rest_length=0.4)
ACROSS = fj.forces.Tension(fj.Point(1, 0.2), fj.Point(3, 0.1, 0.3), 7.0)
PUSH = fj.Wrench(fj.Point(2, 0.4), [3.0, -2.0], 1.5, follows=True)
ACTUATOR = fj.LinearActuator(
    fj.Point(0, -0.6, -0.8), fj.Point(2, 0.4, 0.3),
    force=5.0, mass=[1.2, 0.7], com=[0.2, 0.3], inertia=[0.05, 0.03],
)  # fmt: skip
JOINTS = fj.JointDamper(0.5), fj.JointEffort([1.0, -2.0, 0.7])
each_topology = pytest.mark.parametrize("topology", fj.TOPOLOGIES)


def instant(linkage, q, qd, forces):
    """Returns the reactions and the accelerations at one moment."""
    rows = jnp.zeros(1), jnp.asarray(q)[None], jnp.asarray(qd)[None]
    result = fj.Solution(*rows, {}, diffrax.RESULTS.successful)
    reactions = fj.joint_reactions(linkage, forces, result)[0]
    tau = fj.joint_efforts(linkage, forces, result).total[0]
    return np.asarray(reactions), fj.forward_dynamics(linkage, q, qd, tau, forces)


def second(function, q, qd, qdd):
    """Returns the second derivative in time of a function of the positions."""
    rate = lambda q, qd: jax.jvp(function, (q,), (qd,))[1]
    q, qd, qdd = map(jnp.asarray, (q, qd, qdd))
    return np.asarray(jax.jvp(rate, (q, qd), (qd, qdd))[1])


@eqx.filter_jit
def loads_of(elements, linkage, q, qd):
    """Returns the loads, and where they act."""
    parts = frames(linkage, q)
    return [
        (load, load.point.position(linkage, q))
        for element in elements
        for load in element.loads(element.schedule(0.0, linkage), parts, qd)
    ]


def cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


@each_topology
def test_each_link_is_in_balance(topology):
    """Checks for each link that bearings, loads and weight sum to m a and I alpha."""
    linkage, q, qd = random_motion(topology)
    forces = SPRING, ACROSS, PUSH, *JOINTS
    reactions, qdd = instant(linkage, q, qd, forces)
    accelerations = second(lambda q: fj.mass_centers(linkage, q), q, qd, qdd)
    angle = lambda q: fj.paper.to_chain(linkage, q, jnp.zeros(3))[0][1::2]
    spins = second(angle, q, qd, qdd)
    centers = np.asarray(fj.mass_centers(linkage, q))
    starts = np.asarray(fj.joint_positions(linkage, q))
    loads = jax.tree.map(np.asarray, loads_of((SPRING, ACROSS, PUSH), linkage, q, qd))
    weight = np.array([0, -float(linkage.gravity)])
    mass, inertia = map(np.asarray, (linkage.mass, linkage.inertia))
    for k in range(3):
        force = mass[k] * weight + reactions[k, :2]
        moment = reactions[k, 2] + cross(starts[k] - centers[k], reactions[k, :2])
        if k < 2:
            force = force - reactions[k + 1, :2]
            arm = starts[k + 1] - centers[k]
            moment = moment - reactions[k + 1, 2] - cross(arm, reactions[k + 1, :2])
        for load, place in loads:
            if load.point.link == k + 1:
                total = complex(load.force)
                push = np.array([total.real, total.imag])
                force = force + push
                moment = moment + float(load.moment) + cross(place - centers[k], push)
        size = np.abs(reactions).max()
        np.testing.assert_allclose(force, mass[k] * accelerations[k], atol=1e-10 * size)
        np.testing.assert_allclose(moment, inertia[k] * spins[k], atol=1e-10 * size)


def along_pairs(linkage, x, reactions):
    """Returns the parts of reactions along the slides, and their moments, (6,)."""
    before = np.array([linkage.base_angle, *x[1:5:2]])
    across = np.stack([-np.sin(before), np.cos(before)], axis=1)
    slide = np.sum(across * reactions[:, :2], axis=1)
    return np.stack([slide, reactions[:, 2]], axis=1).ravel()


@pytest.mark.slow
@each_topology
def test_free_components_are_efforts_and_others_the_paper_s_constraint_forces(topology):
    linkage, q, qd = random_motion(topology)
    real = np.asarray(linkage.ef) > 0.5
    effort = sum(e(0.0, q, qd, linkage) for e in JOINTS)
    x, xd = fj.paper.to_chain(linkage, q, qd)
    force = np.zeros(6)
    force[real] = effort
    exact = np.asarray(fj.paper.constraint_forces(linkage, x, xd, force))
    reactions, _ = instant(linkage, q, qd, JOINTS)
    parts, size = along_pairs(linkage, x, reactions), np.abs(reactions).max()
    assert np.abs(exact).max() > 0.1
    np.testing.assert_allclose(parts[~real], exact[~real], atol=1e-10 * size)
    forces = SPRING, ACTUATOR, fj.forces.Armature(0.3), *JOINTS
    reactions, qdd = instant(linkage, q, qd, forces)
    parts, size = along_pairs(linkage, x, reactions), np.abs(reactions).max()
    np.testing.assert_allclose(parts[real], effort - 0.3 * qdd, atol=1e-10 * size)


@each_topology
def test_mujoco_has_the_same_reactions(topology):
    linkage, q, qd = random_motion(topology)
    reactions, _ = instant(linkage, q, qd, JOINTS)
    model = mujoco.MjModel.from_xml_string(fj.to_mjcf(linkage))
    data = mujoco.MjData(model)
    data.qpos, data.qvel = q, qd
    data.qfrc_applied = sum(e(0.0, q, qd, linkage) for e in JOINTS)
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    starts = np.asarray(fj.joint_positions(linkage, q))
    for k in range(3):
        body = model.body(f"link{k + 1}").id
        moment, force = data.cfrc_int[body, 2], data.cfrc_int[body, 3:5]
        center = data.subtree_com[model.body_rootid[body], :2]
        moment = moment + cross(center - starts[k], force)
        size = np.abs(reactions).max()
        np.testing.assert_allclose(reactions[k], [*force, moment], atol=1e-9 * size)


@pytest.mark.slow
@pytest.mark.parametrize("topology", [*fj.TOPOLOGIES, "RFR"])
def test_mujoco_s_rotors_have_the_same_dynamics_and_reactions(topology):
    """Bodies that spin on the links before; the gears give their rates and efforts."""
    linkage, q, qd = random_motion(topology)
    real = moving(topology)
    q, qd = np.where(real, q, 0), np.where(real, qd, 0)
    inertia, gear = np.array([0.3, 0.2, 0.4]), np.array([2.0, -1.5, 3.0])
    forces = fj.forces.Rotor(inertia, gear), *JOINTS
    reactions, qdd = instant(linkage, q, qd, forces)

    root = ElementTree.fromstring(fj.to_mjcf(linkage))
    for k in np.flatnonzero(real):
        before = root.find(f".//body[@name='{f'link{k}' if k else 'ground'}']")
        rotor = ElementTree.SubElement(before, "body")
        ElementTree.SubElement(rotor, "joint", name=f"rotor{k + 1}", axis="0 0 1")
        own = dict(mass="1e-13", diaginertia=" ".join([str(inertia[k])] * 3))
        ElementTree.SubElement(rotor, "inertial", own, pos="0 0 0")
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, "unicode"))
    data = mujoco.MjData(model)
    for k in np.flatnonzero(real):
        for name, ratio in ((f"joint{k + 1}", 1.0), (f"rotor{k + 1}", gear[k])):
            joint = data.joint(name)
            joint.qpos, joint.qvel, joint.qacc = ratio * np.array([q, qd, qdd])[:, k]
    mujoco.mj_inverse(model, data)
    mujoco.mj_rnePostConstraint(model, data)

    size = np.abs(reactions).max()
    for k in np.flatnonzero(real):
        needed = data.joint(f"joint{k + 1}").qfrc_inverse
        needed = needed + gear[k] * data.joint(f"rotor{k + 1}").qfrc_inverse
        effort = sum(e(0.0, q, qd, linkage)[k] for e in JOINTS)
        np.testing.assert_allclose(needed, effort, atol=1e-10 * size)
    starts = np.asarray(fj.joint_positions(linkage, q))
    for k in np.flatnonzero(real):
        body = model.body(f"link{k + 1}").id
        moment, force = data.cfrc_int[body, 2], data.cfrc_int[body, 3:5]
        center = data.subtree_com[model.body_rootid[body], :2]
        moment = moment + cross(center - starts[k], force)
        np.testing.assert_allclose(reactions[k], [*force, moment], atol=1e-9 * size)


@eqx.filter_jit
def efforts_of_loads(linkage, q, qd, qdd):
    parts = frames(linkage, q)
    loads = ACTUATOR.loads(0.0, q, qd, qdd, linkage)
    return sum(jnp.stack(load.efforts(parts)) for load in loads)


@pytest.mark.slow
@each_topology
def test_pins_carry_the_actuator(topology):
    """Checks that the loads of its pins give the actuator's terms of the equations."""
    linkage, q, qd = random_motion(topology)
    tau = fj.JointEffort([1.0, -2.0, 0.7])(0.0, q, qd, linkage)
    total = tau + ACTUATOR(0.0, q, qd, linkage)
    qdd = fj.forward_dynamics(linkage, q, qd, total, (ACTUATOR,))
    by_loads = efforts_of_loads(linkage, q, qd, qdd)
    alone = fj.forward_dynamics(linkage, q, qd, tau + by_loads)
    np.testing.assert_allclose(alone, qdd, rtol=1e-9, atol=1e-9 * np.abs(qdd).max())


class TipLoad(fj.forces.InertialElement):
    """A point mass at the tip, which may declare where it is carried."""

    mass: float = 2.0

    def coordinates(self, q, linkage):
        return fj.tip_position(linkage, q)

    def weights(self, linkage):
        return jnp.full(2, self.mass)

    def potential_energy(self, q, linkage):
        return self.mass * linkage.gravity * fj.tip_position(linkage, q)[1]


class CarriedTipLoad(TipLoad):
    def loads(self, t, q, qd, qdd, linkage):
        place = lambda q: fj.tip_position(linkage, q)
        rate = lambda q, qd: jax.jvp(place, (q,), (qd,))[1]
        _, (x, y) = jax.jvp(rate, (q, qd), (qd, qdd))
        push = -self.mass * x, -self.mass * (y + linkage.gravity)
        return (fj.forces.Load(fj.Point(3, 1.0), push),)


@pytest.mark.slow
def test_an_element_of_one_s_own_is_carried_or_refused():
    arm = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 1],
        inertia=[1 / 12] * 3,
    )  # fmt: skip
    # The last link with the load as a part of it.
    heavy = arm.replace(
        com=[[0.5, 0], [0.5, 0], [2.5 / 3, 0]], mass=[1, 1, 3],
        inertia=[1 / 12, 1 / 12, 1 / 12 + 1 / 6],
    )  # fmt: skip
    q, qd = np.array([-0.3, 0.4, 0.2]), np.array([0.5, -0.3, 0.7])
    found, qdd = instant(arm, q, qd, (CarriedTipLoad(),))
    expected, same = instant(heavy, q, qd, ())
    np.testing.assert_allclose(qdd, same, rtol=1e-10)
    np.testing.assert_allclose(found, expected, atol=1e-10)
    with pytest.raises(ValueError, match=r"forces\[0\]: expected .* `loads`"):
        instant(arm, q, qd, (TipLoad(),))
