"""Derivatives of arms that rest, whose motion has no error that would bound a step.

An arm at rest obeys its linearised equations, whose matrix exponential is exact. The
linearisation is that of the equations at one instant, not of any integrator. A slide
under linear forces obeys them wherever it is: from a lively start, at rest, and after.
"""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR, SLIDE
from helpers import Hold
from modes import ADJOINT, LOOPS
from scipy.linalg import expm

import fdof_jax as fj

HANGING = BAR.replace(base_angle=-np.pi / 2)


class Pushes(eqx.Module):
    """Efforts that grow with the time from the first of the times to the second."""

    times: jax.Array
    rate: jax.Array

    @property
    def jump_ts(self):
        return self.times

    def __call__(self, t, q, qd, linkage):
        begin, end = self.times
        return jnp.where((begin <= t) & (t < end), self.rate * (t - begin), 0)


def changed(numbers, scene):
    """Returns arm and forces with other efforts and masses, and the start."""
    arm, forces = scene[:2]
    tau, log_mass, q0, qd0 = numbers
    arm = eqx.tree_at(lambda a: a.mass, arm, arm.mass * jnp.exp(log_mass))
    forces = eqx.tree_at(lambda f: f[0].tau, forces, forces[0].tau + tau)
    return arm, forces, fj.State(q0, qd0)


def end(numbers, scene, adjoint, rtol=None):
    """Returns a weighted sum of the last positions and velocities, and steps."""
    arm, forces, start = changed(numbers, scene)
    options = dict(adjoint=adjoint, throw=False, rtol=rtol, atol=rtol)
    motion = fj.simulate(arm, start, jnp.stack([0.0, scene[2]]), forces, **options)
    last = jnp.concatenate([motion.q[-1], motion.qd[-1]])
    # Of a failed motion nothing may count.
    good = motion.result == diffrax.RESULTS.successful
    return jnp.where(good, scene[3] @ last, jnp.nan), motion.stats["num_steps"]


def by(adjoint):
    gradient = jax.grad(lambda *at: end(*at, adjoint), has_aux=True)
    return eqx.filter_jit(gradient, **LOOPS)


# For `jax.grad`: by tangents in a few numbers, by the adjoint with checkpoints.
# Forward mode is in hard/test_motions.py.
by_tangents, by_adjoint = by(diffrax.RecursiveCheckpointAdjoint()), by(ADJOINT)


@eqx.filter_jit
def linearised(numbers, scene):
    """Returns the rates at the start, and their derivatives in state and numbers."""

    def rates(state, numbers):
        arm, forces, (q, _) = changed(numbers, scene)
        q, qd = state[: len(q)], state[len(q) :]
        tau = sum(element(0.0, q, qd, arm) for element in forces)
        return jnp.concatenate([qd, fj.forward_dynamics(arm, q, qd, tau)])

    state = jnp.concatenate(numbers[2:])
    in_state, in_numbers = jax.jacfwd(rates, (0, 1))(state, numbers)
    return rates(state, numbers), in_state, jnp.hstack(in_numbers[:2])


def exact(numbers, scene):
    """Returns the gradient of `end`, by a matrix exponential, and the fastest rate."""
    rates, in_state, in_numbers = map(np.asarray, linearised(numbers, scene))
    assert np.abs(rates).max() < 1e-11  # at rest
    size, count = in_numbers.shape
    matrix = np.pad(np.hstack([in_state, in_numbers]), ((0, count), (0, 0)))
    whole = expm(float(scene[2]) * matrix)[:size]
    modes = np.linalg.eigvals(in_state)
    columns = np.hstack([whole[:, size:], whole[:, :size]])
    return np.asarray(scene[3]) @ columns, modes


def flat(gradient):
    return np.concatenate([np.asarray(part) for part in gradient])


def error(found, wanted):
    return np.linalg.norm(found - wanted) / np.linalg.norm(wanted)


# One structure for all arms of as many joints: elements of no effect have coefficients
# of 0, so that one program in each mode serves all.


def held_by(kind, rng, topology):
    """Returns a random arm at rest, which something of this kind holds or damps."""
    n, none = len(topology), np.zeros(len(topology))
    arm = fj.Linkage(
        topology, length=rng.uniform(0.3, 1, n + 1), com=rng.uniform(0.1, 0.5, (n, 2)),
        mass=rng.uniform(0.5, 2, n), inertia=rng.uniform(0.05, 0.3, n),
        base_angle=rng.uniform(-3, 3),
    )  # fmt: skip
    q = rng.uniform(-1, 1, n)
    moved = lambda qdd: fj.inverse_dynamics(arm, q, none, qdd)
    inertia = np.diag(jax.jacfwd(moved)(jnp.zeros(n)))
    damping, kp, kd, friction, stiffness = (none for _ in range(5))
    speed, touching = 0.01, rng.random(n) < 0.5
    if kind == "damper":
        damping = inertia * 10 ** rng.uniform(0, 4)
    if kind == "PD":  # critically damped and overdamped
        frequency = 10 ** rng.uniform(0.3, 1.7, n)
        kp = inertia * frequency**2
        kd = 2 * inertia * frequency * 10 ** rng.uniform(0, 1.5)
    if kind == "friction":
        friction, speed = inertia * rng.uniform(0.1, 3, n), 10 ** rng.uniform(-2.5, -1)
    if kind == "stops":
        damping, stiffness = 3 * inertia, inertia * 10 ** rng.uniform(1, 4)
    acting = (
        fj.JointDamper(damping),
        fj.PDController(kp, kd, none + np.inf, Hold(jnp.asarray(q - 0.05))),
        fj.forces.JointFriction(friction, speed=speed),
        fj.forces.JointStops(
            np.where(touching, q + 0.01, q - 1), q + 5, stiffness=stiffness + 1e-9,
            damping=0.3, smoothing=1e-3,
        ),
    )  # fmt: skip
    given = sum(np.asarray(e(0.0, jnp.asarray(q), none, arm)) for e in acting)
    balance = fj.JointEffort(np.asarray(moved(jnp.zeros(n))) - given)
    time, weights = rng.choice([0.5, 2.0, 10.0]), rng.standard_normal(2 * n)
    numbers = tuple(map(jnp.asarray, (none, none, q, none)))
    return numbers, (arm, (balance, *acting), *map(jnp.asarray, (time, weights)))


def hanging(damping):
    """Returns a bar that hangs in a damper, in the structure of `held_by`."""
    numbers, (_, (balance, damper, *others), *_) = held_by(
        "nothing", np.random.default_rng(0), "R"
    )
    numbers = tuple(map(jnp.zeros_like, numbers))
    balance = eqx.tree_at(lambda b: b.tau, balance, jnp.zeros(1))
    damper = eqx.tree_at(lambda d: d.coefficient, damper, jnp.array([damping]))
    time = jnp.array(2.0 if damping else 10.0, float)  # no weak type
    return numbers, (HANGING, (balance, damper, *others), time, jnp.array([1.0, 0]))


DAMPINGS = 0.0, 1.0, 10.0, 30.0, 100.0, 1e3, 1e4
KINDS = "damper", "PD", "friction", "stops"
RNG = np.random.default_rng(5)
ONE_JOINT = {f"in damping of {d:g}": hanging(d) for d in DAMPINGS}
ONE_JOINT |= {f"{kind}, {k}": held_by(kind, RNG, "R") for kind in KINDS for k in "ab"}


@pytest.mark.parametrize("name", ONE_JOINT)
def test_one_joint_at_rest(name):
    scene = ONE_JOINT[name]
    assert error(flat(by_tangents(*scene)[0]), exact(*scene)[0]) < 1e-6


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:prismatic joints")
def test_random_arms_at_rest():
    """24 scenes of two joints, by the adjoint."""
    rng, solved = np.random.default_rng(2), 0
    while solved < 24:
        kind = rng.choice(["nothing", *KINDS])
        # An arm of slides alone is refused.
        numbers, scene = held_by(kind, rng, "R" + rng.choice([*"RRP"]))
        wanted, rates = exact(numbers, scene)
        time = float(scene[2])
        # Rounding errors make unstable arms leave their pose; many steps take minutes.
        if rates.real.max() * time > 5 or np.abs(rates).max() * time > 3e4:
            continue
        found, steps = by_adjoint(numbers, scene)
        assert error(flat(found), wanted) < 1e-6, (kind, int(steps))
        solved += 1


# A slide with a controller: its motion is a matrix exponential.
GOAL = 0.5


@partial(jax.jit, **LOOPS)
@jax.grad
def slope(x):
    """Of the last place, in gains, mass, start, push and times."""
    kp, kd, mass, q, qd, rate, begin, length, end = x
    arm = eqx.tree_at(lambda a: a.mass, SLIDE, mass[None])
    pd = fj.PDController(kp, kd, np.inf, fj.references.SetPoint([GOAL]))
    push = Pushes(jnp.stack([begin, begin + length]), rate[None])
    start, ts = fj.State(q[None], qd[None]), jnp.stack([0.0, end])
    motion = fj.simulate(arm, start, ts, (pd, push), adjoint=ADJOINT)
    return motion.q[-1, 0] + 0.1 * motion.qd[-1, 0]


@jax.jit
@jax.grad
def exact_slope(x):
    kp, kd, mass, q, qd, rate, begin, length, end = x
    # Of position, velocity, push, its rate and 1
    matrix = jnp.zeros((5, 5)).at[[0, 2], [1, 3]].set(1)
    matrix = matrix.at[1].set(jnp.stack([-kp, -kd, 1.0, 0.0, kp * GOAL]) / mass)
    after = lambda time: jax.scipy.linalg.expm(time * matrix, max_squarings=40)
    state = jnp.stack([q, qd, 0.0, 0.0, 1.0])
    state = (after(begin) @ state).at[3].set(rate)
    state = (after(length) @ state).at[2:4].set(0)
    state = after(end - begin - length) @ state
    return state[0] + 0.1 * state[1]


@pytest.mark.slow
@pytest.mark.parametrize("end", [1.0, 10.0, 100.0])
def test_a_slide_that_comes_to_rest_and_is_pushed_again(end):
    x = jnp.array([40.0, 12, 1.5, 0.3, 2, 40, end - 0.4, 0.2, end])
    assert error(slope(x), exact_slope(x)) < 1e-8


@pytest.mark.slow
def test_numbers_of_very_different_size_have_exact_derivatives():
    """On the second of two slides at right angles; the first one does not move it."""
    arm = fj.Linkage(
        "PP", length=[0, 0, 1], com=[[0, 0]] * 2, mass=[1, 1], inertia=[0.1, 0.1],
        locked=[np.pi / 2, 0], gravity=0,
    )  # fmt: skip
    damper = fj.JointDamper([0.1, 100.0])

    @partial(jax.jit, **LOOPS)
    @jax.grad
    def slope(tau, repelled, place, end):
        push = lambda t, q, qd, linkage: repelled * q * jnp.array([1.0, 0.0])
        start, ts = fj.State(place, jnp.zeros(2)), jnp.stack([0.0, end])
        return fj.simulate(arm, start, ts, (push, damper, fj.JointEffort(tau))).q[-1, 1]

    exact = lambda t: (t - (1 - np.exp(-100 * t)) / 100) / 100
    for tau in (1e-3, 1e-9, 6e-17, 0.0):
        found = slope(jnp.array([1.0, tau]), 0.0, jnp.full(2, 0.5), 2.0)
        np.testing.assert_allclose(found, [0, exact(2.0)], rtol=1e-7, atol=1e-15)
    # The derivative of the first position in its effort grows to 1e12.
    # A probe grows with it, and would hide the other joint.
    found = slope(jnp.zeros(2), 18.0, jnp.zeros(2), 10.0)
    np.testing.assert_allclose(found[1], exact(10.0), rtol=1e-7)
