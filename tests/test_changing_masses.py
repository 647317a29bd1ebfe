"""Masses that depend on time: closed forms, SciPy, reactions, energies, derivatives."""

import diffrax
import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from held_scenes import Row, check_motion
from modes import LOOPS
from scipy.integrate import solve_ivp

import fdof_jax as fj
from fdof_jax.pictures.energy_balance import energy_balance

G, TIP = 9.81, fj.Point(1, 1.0)
TS = np.linspace(0, 1, 101)


class Bucket(fj.forces.Payload):
    """A point mass that leaks."""

    leak: fj.Values = fj.field((), unit="kg/s", kw_only=True)

    def at(self, t):
        left = jnp.where(self.there(t), self.mass - self.leak * t, 0)
        return fj.forces.Payload(self.place, left)


BUCKET = Bucket(TIP, 3.0, leak=2.0)
# A vertical slide of 1 kg, and a bar of 1 m and 1 kg on a pivot
SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], base_angle=0.0
)
BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])


def left_in(t):
    """Returns the mass of `BUCKET` [kg]."""
    return 3 - 2 * t


@eqx.filter_jit(**LOOPS)
def moved(linkage, start, push, leak):
    """Returns a motion, and how its positions change with the leak."""

    def motion(leak):
        forces = fj.JointEffort(push), Bucket(TIP, 3.0, leak=leak)
        options = dict(adjoint=diffrax.ForwardMode())
        found = fj.simulate(linkage, start, TS, forces, **options)
        return found.q[:, 0], found

    _, slope, found = jax.jvp(motion, (leak,), (1.0,), has_aux=True)
    return found, slope


@pytest.mark.slow
def test_a_leaking_slide_moves_as_a_rocket():
    """Under a constant force: (1 + m) qdd = F - (1 + m) g."""

    def lifted(leak, t=TS, force=45.0):
        end = 4 / leak
        left = (end - t) / end
        q = force / leak * ((end - t) * jnp.log(left) + t) - G * t**2 / 2
        return q, -force / leak * jnp.log(left) - G * t

    motion, slope = moved(SLIDE, fj.State([0.0], [0.0]), np.array([45.0]), 2.0)
    (q, qd), (change, _) = jax.jvp(lifted, (2.0,), (1.0,))
    np.testing.assert_allclose(motion.q[:, 0], q, atol=1e-9)
    np.testing.assert_allclose(motion.qd[:, 0], qd, atol=1e-9)
    np.testing.assert_allclose(slope, change, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_a_leaking_pendulum_moves_as_scipy_has_it():
    def rates(t, y):
        q, qd = y
        return qd, -(0.5 + left_in(t)) * G * np.cos(q) / (1 / 3 + left_in(t))

    settings = dict(method="DOP853", rtol=1e-13, atol=1e-13, t_eval=TS)
    q, qd = solve_ivp(rates, (0, 1), [0.3, 1.0], **settings).y
    motion, _ = moved(BAR, fj.State([0.3], [1.0]), np.zeros(1), 2.0)
    np.testing.assert_allclose(motion.q[:, 0], q, atol=1e-9)
    np.testing.assert_allclose(motion.qd[:, 0], qd, atol=1e-9)
    # The energy balance has what the leak takes along [W].
    loss = 2 * (qd**2 / 2 + G * np.sin(q))
    _, bands, line = energy_balance(BAR, (BUCKET,), motion)
    np.testing.assert_allclose(sum(bands.values()), line, rtol=1e-12)
    put_in, out = line - line[0], bands["taken out"]
    lost = np.append(0, np.cumsum((loss[1:] + loss[:-1]) / 2) * 0.01)
    np.testing.assert_allclose(out - put_in, lost, atol=1e-2)


def rows_of(q, qd):
    """Returns a motion of states that no solver has made."""
    rows = (jnp.asarray(x)[:, None] for x in (q, qd))
    return fj.Solution(jnp.asarray(TS), *rows, {}, diffrax.RESULTS.successful)


@pytest.mark.slow
def test_functions_of_an_instant_have_the_mass_of_its_time():
    t, q, qd = 0.4, jnp.array([0.7]), jnp.array([1.3])
    now, mass = (BUCKET.at(t),), left_in(0.4)
    inertia, moment = 1 / 3 + mass, (0.5 + mass) * G * np.cos(0.7)
    np.testing.assert_allclose(fj.mass_matrix(BAR, q, now), [[inertia]])
    np.testing.assert_allclose(fj.bias_force(BAR, q, qd, now), [moment])
    energies = inertia * 1.3**2 / 2, (0.5 + mass) * G * np.sin(0.7)
    np.testing.assert_allclose(fj.energy(BAR, q, qd, now), energies)
    tau = fj.analysis.holding_efforts(BAR, q, (BUCKET,), t)
    np.testing.assert_allclose(tau, [moment])
    qdd = fj.forward_dynamics(BAR, q, qd, [2.0], now)
    np.testing.assert_allclose(qdd, [(2 - moment) / inertia])
    np.testing.assert_allclose(fj.inverse_dynamics(BAR, q, qd, qdd, now), [2.0])


@pytest.mark.slow
def test_bearings_carry_the_mass_of_the_time():
    q, qd, mass = np.sin(3 * TS), np.cos(TS), left_in(TS)
    qdd = -(0.5 + mass) * G * np.cos(q) / (1 / 3 + mass)
    force = (0.5 + mass) * (1j * qdd - qd**2) * np.exp(1j * q) + 1j * (1 + mass) * G
    expected = np.stack([force.real, force.imag, 0 * q], axis=1)
    found = fj.joint_reactions(BAR, (BUCKET,), rows_of(q, qd))[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.slow
def test_a_motor_lifts_the_mass_of_the_time():
    follow = lambda t, linkage: (jnp.array([t**2]), jnp.array([2 * t]))
    forces = fj.simulation.PrescribedMotion(1, follow), BUCKET
    motion = rows_of(TS**2, 2 * TS)
    effort = fj.joint_efforts(SLIDE, forces, motion).elements[0, :, 0]
    np.testing.assert_allclose(effort, (1 + left_in(TS)) * (2 + G), rtol=1e-12)
    reactions = fj.joint_reactions(SLIDE, forces, motion)[:, 0]
    np.testing.assert_allclose(reactions[:, 1], effort, rtol=1e-12)


def bouncing(linkage, q, qd, begin):
    floor = fj.forces.HardStops(0.0, np.inf, restitution=0.5)
    start = fj.State(np.array([q]), np.array([qd]))
    return fj.Scene(linkage, start, (floor, BUCKET.replace(begin=begin)), 1.0)


def taken_by_a_blow(height):
    mass = left_in(np.sqrt(2 * height / G))  # when it hits the floor
    return dict(taken=[0.75 * (1 + mass) * G * height])


# What leaks keeps its own rate.
ROWS = {
    "a bucket that is taken has the mass of that time": Row(
        lambda: bouncing(BAR.replace(gravity=0), 0.0, 2.0, 0.5), (), [0, 1.0],
        lambda: dict(qd=[2 / (1 + 3 * left_in(0.5))]),
    ),
    "a blow takes energy of the mass of its time": Row(
        lambda height: bouncing(SLIDE, height, 0.0, -1.0), (1.0,), [0, 0.6],
        taken_by_a_blow,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_closed_forms(name):
    check_motion(ROWS[name], name)


def test_masses_that_never_change_are_themselves_at_a_time():
    for element in elements.WITH_INERTIA.values():
        assert element.at(jnp.array(0.3)) is element
