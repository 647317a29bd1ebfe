"""Elements with inertia: an independent Lagrangian, energy and inverse dynamics."""

import equinox as eqx
import jax
import mujoco
import numpy as np
import pytest
from helpers import random_linkage

import fdof_jax as fj

PINS = fj.Point(0, -0.6, -0.8), fj.Point(2, 0.4, 0.3)
ACTUATOR = fj.LinearActuator(
    *PINS, force=5.0, mass=[1.2, 0.7], com=[0.2, 0.3], inertia=[0.05, 0.03]
)
ARMATURE = fj.forces.Armature([0.3, 0.2, 0.1])
ELEMENTS = {"armature": ARMATURE, "actuator": ACTUATOR}


def motion(topology, seed=0):
    rng = np.random.default_rng(seed)
    return random_linkage(topology, rng), *rng.uniform(-1, 1, (2, 3))


def pins(linkage, q):
    """Returns the two pins as complex numbers, written out."""
    x, _ = fj.paper.to_chain(linkage, q, np.zeros(3))
    x = np.asarray(x)
    turn = np.exp(1j * np.array([linkage.base_angle, *x[1::2]]))
    start = np.cumsum((np.asarray(linkage.length)[:3] + 1j * x[0::2]) * turn[:3])
    return (-0.6 - 0.8j) * turn[0], start[1] + (0.4 + 0.3j) * turn[2]


def bodies(linkage, q):
    """Returns the mass centres and the angle of cylinder and piston."""
    a, b = pins(linkage, q)
    unit = (b - a) / abs(b - a)
    return a + 0.2 * unit, b - 0.3 * unit, np.angle(unit)


def lagrange(linkage, q, qd, qdd, h=1e-4):
    """Returns both bodies' generalised forces, by differences along the motion."""
    jacobian = []
    for e in np.eye(3):
        ahead, behind = bodies(linkage, q + h * e), bodies(linkage, q - h * e)
        jacobian.append([(x - y) / (2 * h) for x, y in zip(ahead, behind)])
    positions = [bodies(linkage, q + qd * t + qdd * t**2 / 2) for t in (-h, 0.0, h)]
    second = [(x - 2 * y + z) / h**2 for x, y, z in zip(*positions)]
    weight = 1j * float(linkage.gravity)
    pulls = [1.2 * (second[0] + weight), 0.7 * (second[1] + weight), 0.08 * second[2]]
    return np.array(
        [sum((np.conj(c) * p).real for c, p in zip(row, pulls)) for row in jacobian]
    )


@eqx.filter_jit
def acting(element, q, qd, linkage):
    return element(0.0, q, qd, linkage)


@eqx.filter_jit
def energy_rates(forces, linkage, q, qd, qdd):
    energies = lambda q, qd: fj.energy(linkage, q, qd, forces)
    return jax.jvp(energies, (q, qd), (qd, qdd))[1]


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_the_actuator_s_bodies_by_another_lagrangian(topology):
    linkage, q, qd = motion(topology)
    qdd = np.array([0.3, -0.7, 1.1])
    bare = fj.inverse_dynamics(linkage, q, qd, qdd)
    full = fj.inverse_dynamics(linkage, q, qd, qdd, (ACTUATOR,))
    exact = lagrange(linkage, q, qd, qdd)
    assert np.abs(exact).max() > 0.05
    np.testing.assert_allclose(full - bare, exact, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_the_actuator_s_force_does_its_power(topology):
    linkage, q, qd = motion(topology)
    a, b = (np.array(pins(linkage, q + h * qd)) for h in (1e-6, -1e-6))
    rate = (abs(a[1] - a[0]) - abs(b[1] - b[0])) / 2e-6
    power = np.asarray(acting(ACTUATOR, q, qd, linkage)) @ qd
    np.testing.assert_allclose(power, 5.0 * rate, atol=1e-8)


def test_the_actuator_s_force_may_depend_on_its_length():
    linkage, q, qd = motion("RRR")
    spring = fj.LinearActuator(*PINS, force=lambda t, length, rate: -30 * length - rate)
    same = fj.SpringDamper(*PINS, stiffness=30.0, damping=1.0)
    np.testing.assert_allclose(
        spring(0.0, q, qd, linkage), same(0.0, q, qd, linkage), rtol=1e-12
    )


def test_armature_adds_to_the_diagonal():
    linkage, q, qd = motion("RPR")
    qdd = np.array([0.3, -0.7, 1.1])
    bare = fj.inverse_dynamics(linkage, q, qd, qdd)
    full = fj.inverse_dynamics(linkage, q, qd, qdd, (ARMATURE,))
    np.testing.assert_allclose(full - bare, [0.09, -0.14, 0.11], rtol=1e-10)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
@pytest.mark.parametrize("name", ELEMENTS)
def test_inverse_after_forward(topology, name):
    linkage, q, qd = motion(topology)
    tau, forces = np.array([1.0, -2.0, 0.5]), (ELEMENTS[name],)
    qdd = fj.forward_dynamics(linkage, q, qd, tau, forces)
    back = fj.inverse_dynamics(linkage, q, qd, qdd, forces)
    np.testing.assert_allclose(back, tau, rtol=1e-10)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_energy_and_work(topology):
    """Checks that the energy changes at the power of the force between the pins."""
    linkage, q, qd = motion(topology)
    forces = ACTUATOR, ARMATURE
    tau = sum(np.asarray(acting(element, q, qd, linkage)) for element in forces)
    qdd = np.asarray(fj.forward_dynamics(linkage, q, qd, tau, forces))
    kinetic, potential = map(np.asarray, energy_rates(forces, linkage, q, qd, qdd))
    assert abs(kinetic) > 1e-2
    power = np.asarray(acting(ACTUATOR, q, qd, linkage)) @ qd
    np.testing.assert_allclose(kinetic + potential, power, atol=1e-11 * abs(kinetic))


def in_mujoco(linkage, q, qd):
    """Returns the actuator as two MuJoCo bodies, with the rod tied to its pin."""
    text = fj.to_mjcf(linkage)
    third = text.index('<body name="link3"')
    text = f'{text[:third]}<site name="pin" pos="0.4 0.3 0"/>{text[third:]}'
    bodies = """
      <body pos="-0.6 -0.8 0">
        <joint name="swing" type="hinge" axis="0 0 1"/>
        <inertial pos="0.2 0 0" mass="1.2" diaginertia="0.05 0.05 0.05"/>
        <body>
          <joint name="stroke" type="slide" axis="1 0 0"/>
          <inertial pos="-0.3 0 0" mass="0.7" diaginertia="0.03 0.03 0.03"/>
          <site name="rod"/>
        </body>
      </body>"""
    ground = text.index(">", text.index('<body name="ground"')) + 1
    tie = """
      <option timestep="1e-4" integrator="RK4" tolerance="1e-15"/>
      <equality>
        <connect site1="rod" site2="pin" solref="2e-3 1"
          solimp="0.9999 0.9999 1 0.5 2"/>
      </equality></mujoco>"""
    text = (text[:ground] + bodies + text[ground:]).replace("</mujoco>", tie)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)

    def place(q):
        a, b = pins(linkage, q)
        return np.array([np.angle(b - a) - linkage.base_angle, abs(b - a)])

    joints = lambda *names: [model.joint(name).qposadr[0] for name in names]
    arm, own = joints("joint1", "joint2", "joint3"), joints("swing", "stroke")
    data.qpos[arm], data.qvel[arm] = q, qd
    data.qpos[own] = place(q)
    data.qvel[own] = (place(q + 1e-6 * qd) - place(q - 1e-6 * qd)) / 2e-6
    data.qfrc_applied[own[1]] = 5.0
    return model, data, arm


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_mujoco_with_a_soft_tie(topology):
    """The tie changes accelerations by up to 1e-4, and the motion hardly at all."""
    linkage, q, qd = motion(topology)
    rest = np.zeros(3)
    model, data, arm = in_mujoco(linkage, q, rest)
    mujoco.mj_forward(model, data)
    tau = acting(ACTUATOR, q, rest, linkage)
    own = fj.forward_dynamics(linkage, q, rest, tau, (ACTUATOR,))
    size = np.abs(own).max()
    bare = fj.forward_dynamics(linkage, q, rest, rest)
    assert np.abs(own - bare).max() > 0.1 * size
    np.testing.assert_allclose(data.qacc[arm], own, atol=2e-4 * size)

    model, data, arm = in_mujoco(linkage, q, qd)
    for _ in range(2000):
        mujoco.mj_step(model, data)
    end = fj.simulate(linkage, fj.State(q, qd), [0, 0.2], (ACTUATOR,)).q[-1]
    np.testing.assert_allclose(data.qpos[arm], end, atol=1e-8)


def test_the_conditioning_sees_the_armature():
    """Checks that a heavy rotor makes a light tip on a heavy arm well-conditioned."""
    linkage = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 1e6],
        inertia=[1 / 12] * 3,
    )  # fmt: skip
    q = np.array([0.1, 0.2, 0.3])
    assert fj.analysis.inertia_ratios(linkage, q).min() < 1e-4
    assert (
        fj.analysis.inertia_ratios(linkage, q, (fj.forces.Armature(1e9),)).min() > 0.9
    )
