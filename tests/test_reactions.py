"""Bearing reactions: balance of each link, MuJoCo, elements of one's own."""

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

GROUND, TIP = fj.Point(0, 0.3, -0.8), fj.Point(3, 0.5, 0.2)
SPRING = fj.SpringDamper(GROUND, TIP, stiffness=30.0, damping=2.0, rest_length=0.4)
ACROSS = fj.forces.Tension(fj.Point(1, 0.2), fj.Point(3, 0.1, 0.3), 7.0)
PUSH = fj.Wrench(fj.Point(2, 0.4), [3.0, -2.0], 1.5, follows=True)
ACTUATOR = fj.LinearActuator(
    fj.Point(0, -0.6, -0.8), fj.Point(2, 0.4, 0.3),
    force=5.0, mass=[1.2, 0.7], com=[0.2, 0.3], inertia=[0.05, 0.03],
)  # fmt: skip
JOINTS = fj.JointDamper(0.5), fj.JointEffort([1.0, -2.0, 0.7])


def instant(linkage, q, qd, forces):
    """Returns the reactions and the accelerations at one moment."""
    rows = jnp.zeros(1), jnp.asarray(q)[None], jnp.asarray(qd)[None]
    result = fj.Solution(*rows, {}, diffrax.RESULTS.successful)
    reactions = fj.joint_reactions(linkage, forces, result)[0]
    tau = fj.joint_efforts(linkage, forces, result).total[0]
    return np.asarray(reactions), fj.forward_dynamics(linkage, q, qd, tau, forces)


@eqx.filter_jit
def motion_of_links(linkage, elements, *state):
    """Returns accelerations of mass centres and links, and loads and their places."""

    def places(q):
        x, _ = fj.paper.to_chain(linkage, q, jnp.zeros_like(q))
        return fj.mass_centers(linkage, q), x[1::2]

    q, qd, qdd = map(jnp.asarray, state)
    rate = lambda q, qd: jax.jvp(places, (q,), (qd,))[1]
    loads = [
        (load.point.position(linkage, q), load.vector(), load.moment, load.point.link)
        for element in elements
        for load in element.loads_on_points(0.0, q, qd, qdd, linkage)
    ]
    return jax.jvp(rate, (q, qd), (qd, qdd))[1], loads


def cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


@pytest.mark.slow
@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_each_link_is_in_balance_and_free_components_are_efforts(topology):
    """Bearings, loads and weight sum to m a and I alpha of each link."""
    linkage, q, qd = random_motion(topology)
    forces = SPRING, ACROSS, PUSH, ACTUATOR, fj.forces.Armature(0.3), *JOINTS
    reactions, qdd = instant(linkage, q, qd, forces)
    (gained, spun), loads = motion_of_links(linkage, forces[:4], q, qd, qdd)
    close, tolerance = np.testing.assert_allclose, 1e-10 * np.abs(reactions).max()
    centers = np.asarray(fj.mass_centers(linkage, q))
    starts = np.asarray(fj.joint_positions(linkage, q))
    mass, inertia = map(np.asarray, (linkage.mass, linkage.inertia))
    bearings = [(starts[k], reactions[k], k) for k in range(3)]
    bearings += [(starts[k + 1], -reactions[k + 1], k) for k in range(2)]
    pushes = [(place, row[:2], row[2], k) for place, row, k in bearings]
    for place, push, turn, link in loads:
        pushes.append((place, np.array([push.real, push.imag]), turn, link - 1))
    for k in range(3):
        force, moment = mass[k] * np.array([0, -float(linkage.gravity)]), 0.0
        for place, push, turn, link in pushes:
            if link == k:
                force = force + push
                moment = moment + turn + cross(place - centers[k], push)
        close(force, mass[k] * gained[k], atol=tolerance)
        close(moment, inertia[k] * spun[k], atol=tolerance)
    effort = sum(e(0.0, q, qd, linkage) for e in JOINTS) - 0.3 * qdd
    x, _ = fj.paper.to_chain(linkage, q, qd)
    for k, before in enumerate([linkage.base_angle, *x[1:5:2]]):
        along = -np.sin(before) * reactions[k, 0] + np.cos(before) * reactions[k, 1]
        free = along if topology[k] == "P" else reactions[k, 2]
        close(free, effort[k], atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("topology", ["RPR", "PRR", "RRP", "RFR"])
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

    size, starts = np.abs(reactions).max(), np.asarray(fj.joint_positions(linkage, q))
    for k in np.flatnonzero(real):
        needed = data.joint(f"joint{k + 1}").qfrc_inverse
        needed = needed + gear[k] * data.joint(f"rotor{k + 1}").qfrc_inverse
        effort = sum(e(0.0, q, qd, linkage)[k] for e in JOINTS)
        np.testing.assert_allclose(needed, effort, atol=1e-10 * size)
        body = model.body(f"link{k + 1}").id
        moment, force = data.cfrc_int[body, 2], data.cfrc_int[body, 3:5]
        center = data.subtree_com[model.body_rootid[body], :2]
        moment = moment + cross(center - starts[k], force)
        np.testing.assert_allclose(reactions[k], [*force, moment], atol=1e-9 * size)


class TipLoad(fj.forces.InertialElement):
    """A point mass at the tip, which does not declare where it is carried."""

    def coordinates(self, q, linkage):
        return fj.tip_position(linkage, q)

    def weights(self, linkage):
        return jnp.ones(2)


def test_an_element_that_does_not_say_what_carries_it_is_refused():
    with pytest.raises(ValueError, match=r"forces\[0\]: expected .* `loads`"):
        instant(*random_motion("RRR"), (TipLoad(),))
