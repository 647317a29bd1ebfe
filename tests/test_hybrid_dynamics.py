"""Prescribed motion: closed forms, balances, jumps of the velocity, residual swings."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chains import random_chain
from elements import SHORT, Swing
from helpers import random_linkage
from modes import LOOPS
from scipy.integrate import simpson, solve_ivp

import fdof_jax as fj

# A cart that slides along x and carries a pendulum: link 3 turns with link 4.
LENGTH, MASS, INERTIA, G = 0.8, 1.5, 0.2, 9.81
with pytest.warns(UserWarning, match="joints 2 and 3 coincide"):
    CART = fj.Linkage(
        "PRR", length=[0, 0, 0, LENGTH], com=[[0, 0], [0, 0], [LENGTH, 0]],
        mass=[2, 0, MASS], inertia=[1, INERTIA, 0], locked=[0, 0, 0],
        base_angle=-np.pi / 2, gravity=G,
    )  # fmt: skip
ROTOR = MASS * LENGTH**2 + INERTIA
FREQUENCY = np.sqrt(MASS * G * LENGTH / ROTOR)
REST = fj.State(np.zeros(3), np.zeros(3))
NONE = fj.JointEffort(np.zeros(3))
AMPLITUDE = jnp.array([0.3, 0.2])


class Push(eqx.Module):
    """The cart starts with a velocity and accelerates at a constant rate."""

    velocity: jax.Array
    acceleration: jax.Array

    def __call__(self, t, linkage):
        x = self.velocity * t + self.acceleration * t**2 / 2
        zero = jnp.zeros_like(x)
        rate = self.velocity + self.acceleration * t
        return jnp.stack([x, zero, zero]), jnp.stack([rate, zero, zero])


def pendulum(angle, rate, acceleration, ts):
    """Returns the motion of a pendulum whose pivot accelerates along x."""

    def field(t, y):
        drive = G * np.sin(y[0]) + acceleration * np.cos(y[0])
        return y[1], -MASS * LENGTH * drive / ROTOR

    options = dict(rtol=1e-12, atol=1e-13)
    return solve_ivp(field, (0, ts[-1]), [angle, rate], "DOP853", ts, **options).y


@pytest.mark.parametrize("acceleration", [0.0, 4.0])
def test_a_pendulum_on_a_cart_that_accelerates(acceleration):
    moving = fj.simulation.PrescribedMotion(
        (1, 3), Push(jnp.array(0.0), jnp.array(acceleration))
    )
    ts = np.linspace(0, 3, 13)
    solution = fj.simulate(CART, fj.State([0, 0.7, 0], np.zeros(3)), ts, (moving,))
    angle, rate = pendulum(0.7, 0.0, acceleration, ts)
    np.testing.assert_allclose(solution.q[:, 1], angle, atol=1e-9)
    np.testing.assert_allclose(solution.qd[:, 1], rate, atol=1e-9)
    np.testing.assert_allclose(solution.q[:, 0], acceleration * ts**2 / 2, atol=1e-12)
    np.testing.assert_array_equal(solution.q[:, 2], 0)


def test_a_jump_of_the_velocity_is_a_blow():
    """Checks that the pendulum's momentum about its pivot does not change."""
    moving = fj.simulation.PrescribedMotion(
        (1, 3), Push(jnp.array(0.6), jnp.array(0.0))
    )
    ts = np.linspace(0, 1, 6)
    start = fj.State([0, 0.4, 0], [0, 0.2, 0])
    solution = fj.simulate(CART, start, ts, (moving,))
    after = 0.2 - MASS * LENGTH * np.cos(0.4) * 0.6 / ROTOR
    angle, rate = pendulum(0.4, after, 0.0, ts)
    np.testing.assert_allclose(solution.q[:, 1], angle, atol=1e-9)
    np.testing.assert_allclose(solution.qd[:, 1], rate, atol=1e-9)
    np.testing.assert_allclose(solution.qd[:, 0], 0.6)
    # The effort, too, is that after the blow: it moves the pendulum's mass centre.
    turning = -MASS * LENGTH * G * np.sin(angle) / ROTOR
    along_x = MASS * LENGTH * (np.cos(angle) * turning - np.sin(angle) * rate**2)
    effort = fj.joint_efforts(CART, (moving,), solution).total[:, 0]
    np.testing.assert_allclose(effort, along_x, atol=1e-7)
    sampled = fj.simulate_sampled(CART, start, NONE, 0.2, 5, (moving,))
    np.testing.assert_allclose(sampled.qd, solution.qd, atol=1e-9)


class Sway(eqx.Module):
    """A reference of two joints; the programs of such arms compile faster."""

    amplitude: jax.Array

    def __call__(self, t, linkage):
        angle = 3 * t + jnp.array([0.0, 1.0])
        return self.amplitude * jnp.sin(angle), 3 * self.amplitude * jnp.cos(angle)


def swinging(topology, joints, forces=()):
    rng, n = np.random.default_rng(3), len(topology)
    linkage = random_linkage(topology, rng) if n == 3 else random_chain(topology, rng)
    swing = Swing(jnp.array([0.3, 0.2, 0.4])) if n == 3 else Sway(AMPLITUDE)
    motion = fj.simulation.PrescribedMotion(joints, swing)
    q, qd = motion.reference(0.0, linkage)
    effort = fj.JointEffort([1.0, -2.0, 0.7][:n])
    forces = (motion, fj.JointDamper(0.5), effort, *forces)
    return linkage, fj.State(q, qd), forces


@eqx.filter_jit
def along(linkage, forces, solution, efforts):
    """Returns accelerations under efforts, the prescribed ones, and the energy."""

    def at(t, q, qd, tau):
        qdd = fj.forward_dynamics(linkage, q, qd, tau, forces)
        demanded = jax.jacfwd(lambda t: forces[0].reference(t, linkage)[1])(t)
        return qdd, demanded, sum(fj.energy(linkage, q, qd, forces))

    return jax.vmap(at)(solution.ts, solution.q, solution.qd, efforts)


@pytest.mark.parametrize("joints", [1, 2, 3, (1, 2), (1, 2, 3)], ids=str)
@pytest.mark.parametrize("topology", ["RRR", "RPR", "PRP"])
def test_efforts_make_the_motion_and_do_its_work(topology, joints):
    armature = fj.forces.Armature(0.3)
    linkage, start, forces = swinging(topology, joints, (armature,))
    ts = np.linspace(0, 1, 101)
    solution = fj.simulate(linkage, start, ts, forces)
    efforts = fj.joint_efforts(linkage, forces, solution)
    moved = np.asarray(forces[0].prescribes(linkage))
    assert (np.asarray(efforts.elements[0])[:, ~moved] == 0).all()
    # Under these efforts the prescribed joints accelerate as they should.
    qdd, demanded, energy = along(linkage, forces, solution, efforts.total)
    np.testing.assert_allclose(qdd[:, moved], demanded[:, moved], atol=1e-9)
    # The energy changes by their work.
    power = np.sum(np.asarray(efforts.total) * np.asarray(solution.qd), axis=1)
    work = simpson(power, x=ts)
    np.testing.assert_allclose(energy[-1] - energy[0], work, atol=1e-6 * np.ptp(power))


def test_a_motion_prescribed_as_it_is_takes_no_effort():
    """A cart and the pendulum that hangs on it fall together, weightless."""
    falling = fj.Linkage(
        "PRR", length=[0, 0, 1, 1], com=[[0, 0], [0.5, 0], [0.5, 0]], mass=[1, 1, 1],
        inertia=[1, 1, 1], gravity=G,
    )  # fmt: skip
    # Its rail is upright.
    motion = fj.simulation.PrescribedMotion(1, Push(jnp.array(0.0), jnp.array(-G)))
    ts = np.linspace(0, 1, 5)
    start = fj.State([0, 0.3, 0.2], np.zeros(3))
    bound = fj.simulate(falling, start, ts, (motion,))
    free = fj.simulate(falling, start, ts)
    np.testing.assert_allclose(bound.q, free.q, atol=1e-9)
    np.testing.assert_allclose(free.q[:, 1:], np.tile([0.3, 0.2], (5, 1)), atol=1e-9)
    effort = fj.joint_efforts(falling, (motion,), bound).total
    np.testing.assert_allclose(effort, 0, atol=1e-9)
    # A turning pendulum pulls at the cart.
    turning = fj.State([0, 0.3, 0.2], [0, 1.0, -0.4])
    pulled = fj.simulate(falling, turning, ts, (motion,))
    effort = fj.joint_efforts(falling, (motion,), pulled).total[:, 0]
    assert np.abs(effort).max() > 0.1


def test_starts_beside_the_reference_and_singular_equations_are_told():
    hold = Push(jnp.array(0.0), jnp.array(0.0))
    motion = fj.simulation.PrescribedMotion((1, 3), hold)
    starts = fj.State(np.array([[0.0, 0.1, 0], [0.2, 0.1, 0]]), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="state0.q: expected"):
        fj.simulate(CART, fj.State(starts.q[1], np.zeros(3)), [0, 1], (motion,))
    swept = fj.sweep(CART, starts, [0, 0.1], (motion,), **SHORT)
    assert swept.outcome.tolist() == ["successful", "not finite"]
    with pytest.raises(ValueError, match="^outcome: expected .* compare `result`"):
        jax.eval_shape(lambda solution: solution.outcome, swept)
    # Two stretched links with a heavy tip; the prescribed slide is well-conditioned.
    heavy = fj.Linkage(
        "PRR", length=[0, 0, 1, 1], com=[[0, 0], [0.5, 0], [1, 0]], mass=[1, 1, 1e12],
        inertia=[1, 0.1, 0], gravity=0,
    )  # fmt: skip
    moving = fj.simulation.PrescribedMotion(1, hold)
    start = fj.State(np.array([0, 0.3, 0.0]), np.zeros(3))
    ended = fj.simulate(heavy, start, [0, 0.1], (moving,), throw=False)
    assert str(ended.outcome) == "ill-conditioned"


@pytest.mark.slow
def test_gradients_equal_differences():
    linkage, start, (motion, *others) = swinging("PR", 1)
    weights = np.array([1.0, -2.0])

    @partial(jax.jit, **LOOPS)
    @jax.value_and_grad
    def both(p):
        reference = Sway(AMPLITUDE * p[0])
        q, qd = reference(0.0, linkage)
        state0 = fj.State(jnp.where(motion.prescribes(linkage), q, start.q), start.qd)
        forces = fj.simulation.PrescribedMotion(1, reference), fj.JointDamper(p[1])
        return weights @ fj.simulate(linkage, state0, [0, 0.5], forces).q[-1]

    p = jnp.array([1.0, 0.5])
    _, slope = both(p)
    wanted = [(both(p + h)[0] - both(p - h)[0]) / 2e-4 for h in 1e-4 * np.eye(2)]
    np.testing.assert_allclose(slope, wanted, atol=1e-6 * np.abs(slope).max())


@pytest.mark.slow
def test_topologies_are_batched():
    """A rotor's inertia beside them takes the batch through the looped solver."""
    members = [swinging(topology, 2) for topology in ("RR", "RP", "PR", "PP")]
    rotor = (fj.forces.Armature(np.array([0.3, 0.2])),)
    stack = lambda trees: jax.tree.map(lambda *a: jnp.stack(a), *trees)
    linkages, starts, forces = map(stack, zip(*members))
    ts = [0, 0.3]
    axes = (*(0 for _ in forces), None)
    swept = fj.sweep(linkages, starts, ts, forces + rotor, forces_axes=axes, **SHORT)
    for k, (linkage, start, forces) in enumerate(members):
        alone = fj.simulate(linkage, start, ts, forces + rotor, **SHORT)
        np.testing.assert_allclose(swept.q[k], alone.q, atol=1e-9)


def residual(travel, stroke=0.05):
    """Returns the load's swing after the travel, divided by the stroke."""
    move = fj.references.JointMove(np.zeros(3), [stroke, 0, 0], travel)
    motion = fj.simulation.PrescribedMotion((1, 3), move)
    ts = np.append(0.0, travel.duration + np.linspace(0.01, 2.5, 200))
    swing = fj.simulate(CART, REST, ts, (motion,)).q[1:, 1]
    reach = ROTOR / (MASS * LENGTH)  # of the equivalent simple pendulum
    return float(np.abs(swing).max() * reach / stroke)


def test_the_shock_removes_residual_vibration():
    plain = fj.references.Travel(1.6, profile="harmonic")
    shock = fj.references.shock_against(plain, FREQUENCY)
    shocked = fj.references.Travel(1.6, profile="harmonic", shock=shock)
    before, after = residual(plain), residual(shocked)
    assert before >= 0.1 and after <= before / 20


def test_malformed_motions_are_refused():
    hold = Push(jnp.array(0.0), jnp.array(0.0))
    for joints in (0, 9, (1, 0), 1.0, (), [1, 2.0], True):
        with pytest.raises(ValueError, match="joints: expected"):
            fj.simulation.PrescribedMotion(joints, hold)
    with pytest.raises(ValueError, match="reference: expected a callable"):
        fj.simulation.PrescribedMotion(1, 3.0)
    motion = fj.simulation.PrescribedMotion(4, hold)
    with pytest.raises(ValueError, match=r"joints: expected 1 to 3, got 4"):
        fj.simulate(CART, REST, [0, 1], (motion,))
    motion = fj.simulation.PrescribedMotion(
        1, lambda t, linkage: (jnp.zeros(2), jnp.zeros(2))
    )
    with pytest.raises(
        ValueError, match=r"^forces\[0\]\.reference: expected an array of 3"
    ):
        fj.simulate(CART, REST, [0, 1], (motion,))
    motion = fj.simulation.PrescribedMotion(1, hold)
    with pytest.raises(ValueError, match="forces: expected one PrescribedMotion"):
        fj.simulate(CART, REST, [0, 1], (motion, motion))
    with pytest.raises(ValueError, match=r"state0\.q: expected \[0.0, .*prescribed"):
        fj.simulate(CART, fj.State([0.1, 0, 0], np.zeros(3)), [0, 1], (motion,))
