"""Masses that depend on time: closed forms, SciPy, reactions, energies, derivatives."""

import diffrax
import elements
import jax
import jax.numpy as jnp
import numpy as np
import pytest
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

# A vertical slide of 1 kg under a constant force: (1 + m) qdd = F - (1 + m) g

SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], base_angle=0.0
)
FORCE = 45.0
PUSH = fj.JointEffort(FORCE)


def lifted(leak, t=TS):
    """Returns the exact motion of the slide with `BUCKET`, as by a rocket's formula."""
    end = 4 / leak
    left = (end - t) / end
    q = FORCE / leak * ((end - t) * jnp.log(left) + t) - G * t**2 / 2
    return q, -FORCE / leak * jnp.log(left) - G * t


def lift(leak, ts=TS, **options):
    forces = (PUSH, Bucket(TIP, 3.0, leak=leak))
    return fj.simulate(SLIDE, fj.State([0.0], [0.0]), ts, forces, **options)


@pytest.mark.slow
def test_a_leaking_slide_has_the_closed_form():
    motion = lift(2.0)
    q, qd = lifted(2.0)
    np.testing.assert_allclose(motion.q[:, 0], q, atol=1e-9)
    np.testing.assert_allclose(motion.qd[:, 0], qd, atol=1e-9)


MODES = [
    (jax.jacfwd, dict(adjoint=diffrax.ForwardMode())),
    (jax.jacrev, {}),
    (jax.jacrev, dict(adjoint=diffrax.RecursiveCheckpointAdjoint(checkpoints=64))),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode, options", MODES)
def test_derivatives_in_the_leak(mode, options):
    last = lambda leak: lift(leak, jnp.array([0.0, 1.0]), **options).q[-1, 0]
    step = 1e-5
    difference = (last(2 + step) - last(2 - step)) / (2 * step)
    exact = jax.grad(lambda leak: lifted(leak, 1.0)[0])(2.0)
    found = mode(last)(2.0)
    np.testing.assert_allclose(found, exact, rtol=1e-8)
    np.testing.assert_allclose(found, difference, rtol=1e-5)


# A bar of 1 m and 1 kg on a pivot, with the bucket at its end

BAR = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])


def swing():
    return fj.simulate(BAR, fj.State([0.3], [1.0]), TS, (BUCKET,))


def left_in(t):
    """Returns the mass of `BUCKET` [kg]."""
    return 3 - 2 * t


@pytest.mark.slow
def test_a_leaking_pendulum_moves_as_scipy_has_it():
    def rates(t, y):
        q, qd = y
        moment = -(0.5 + left_in(t)) * G * np.cos(q)
        return qd, moment / (1 / 3 + left_in(t))

    settings = dict(method="DOP853", rtol=1e-13, atol=1e-13, t_eval=TS)
    expected = solve_ivp(rates, (0, 1), [0.3, 1.0], **settings).y
    motion = swing()
    np.testing.assert_allclose(motion.q[:, 0], expected[0], atol=1e-9)
    np.testing.assert_allclose(motion.qd[:, 0], expected[1], atol=1e-9)


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
    # Inverse after forward
    qdd = fj.forward_dynamics(BAR, q, qd, [2.0], now)
    np.testing.assert_allclose(qdd, [(2 - moment) / inertia])
    np.testing.assert_allclose(fj.inverse_dynamics(BAR, q, qd, qdd, now), [2.0])


@pytest.mark.slow
def test_bearings_carry_the_mass_of_the_time():
    motion = swing()
    q, qd, mass = motion.q[:, 0], motion.qd[:, 0], left_in(TS)
    qdd = -(0.5 + mass) * G * np.cos(q) / (1 / 3 + mass)
    along = jnp.exp(1j * q)
    force = (0.5 + mass) * (1j * qdd - qd**2) * along + 1j * (1 + mass) * G
    expected = np.stack([force.real, force.imag, 0 * q], axis=1)
    found = fj.joint_reactions(BAR, (BUCKET,), motion)[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    assert not np.any(fj.joint_efforts(BAR, (BUCKET,), motion).total)


@pytest.mark.slow
def test_a_motor_lifts_the_mass_of_the_time():
    follow = lambda t, linkage: (jnp.array([t**2]), jnp.array([2 * t]))
    forces = (fj.simulation.PrescribedMotion(1, follow), BUCKET)
    motion = fj.simulate(SLIDE, fj.State([0.0], [0.0]), TS, forces)
    effort = fj.joint_efforts(SLIDE, forces, motion).elements[0, :, 0]
    np.testing.assert_allclose(effort, (1 + left_in(TS)) * (2 + G), rtol=1e-12)
    reactions = fj.joint_reactions(SLIDE, forces, motion)[:, 0]
    np.testing.assert_allclose(reactions[:, 1], effort, rtol=1e-12)


@pytest.mark.slow
def test_the_energy_balance_has_what_leaves():
    motion = swing()
    q, qd = motion.q[:, 0], motion.qd[:, 0]
    loss = 2 * (qd**2 / 2 + G * np.sin(q))  # what leaks takes along [W]
    _, bands, line = energy_balance(BAR, (BUCKET,), motion)
    top = sum(bands.values())
    np.testing.assert_allclose(top, line, rtol=1e-12)
    put_in, out = line - line[0], bands["taken out"]
    lost = np.append(0, np.cumsum((loss[1:] + loss[:-1]) / 2) * 0.01)
    np.testing.assert_allclose(out - put_in, lost, atol=1e-2)


@pytest.mark.slow
def test_a_bucket_that_is_taken_has_the_mass_of_that_time():
    """Without gravity the rate is that after the blow: what leaks keeps its own."""
    floating = BAR.replace(gravity=0)
    load = BUCKET.replace(begin=0.5)
    motion = fj.simulate(floating, fj.State([0.0], [2.0]), TS, (load,))
    after = 2 * (1 / 3) / (1 / 3 + left_in(0.5))
    np.testing.assert_allclose(motion.qd[-1, 0], after, rtol=1e-12)


@pytest.mark.slow
def test_an_impact_takes_energy_of_the_mass_of_its_time():
    """The fall of a slide with the bucket is free: what leaks keeps its speed."""

    def taken(height):
        floor = fj.forces.HardStops(0.0, np.inf, restitution=0.5)
        start, ts = fj.State(height[None], [0.0]), jnp.array([0.0, 0.6])
        forward = dict(adjoint=diffrax.ForwardMode())
        return fj.simulate(SLIDE, start, ts, (floor, BUCKET), **forward).taken[-1]

    exact = lambda height: 0.75 * (1 + left_in(jnp.sqrt(2 * height / G))) * G * height
    values = jax.jit(lambda height: (taken(height), jax.jacfwd(taken)(height)))
    found = values(jnp.array(1.0))
    np.testing.assert_allclose(found, (exact(1.0), jax.grad(exact)(1.0)), rtol=1e-9)


# Programs


@pytest.mark.slow
def test_another_leak_compiles_nothing():
    traces, counts = [], []

    class Counted(Bucket):
        def at(self, t):
            traces.append(t)
            return super().at(t)

    for leak in (1.0, 2.0, 3.0):
        bucket = Counted(TIP, 3.0, leak=leak)
        fj.simulate(SLIDE, fj.State([0.0], [0.0]), TS, (bucket,))
        counts.append(len(traces))
    assert 0 < counts[0] == counts[-1]


@pytest.mark.parametrize("name", elements.WITH_INERTIA)
def test_masses_that_never_change_are_themselves_at_a_time(name):
    element = elements.WITH_INERTIA[name]
    assert element.at(jnp.array(0.3)) is element
