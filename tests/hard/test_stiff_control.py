"""Scenes 17, 18 and 20: stiff controllers and dampers; one chatters at its limit."""

from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from modes import ADJOINT, LOOPS

import fdof_jax as fj
from hard import oracle
from hard.scenes import DRIVEN, START, TARGET, USUAL, Hold, arm

STIFFNESSES = [1e4, 1e6, 1e8]
TS, TENTHS = np.linspace(0, 1, 2001), slice(200, None, 200)
# 1e-9 is one digit more than smooth motions need: at 1e-8 derivatives at kp = 1e6 are
# wrong by 7e-4 while the transient dies, and the chattering motion by 2e-6. The first
# step, tried before anything is known of the rates, has to be short: from 1 ms Newton's
# method diverges at kp = 1e8, and derivatives of the root that it did not find raise.
IMPLICIT: dict[str, Any] = dict(
    solver=diffrax.Kvaerno5(), dt0=1e-6, rtol=1e-9, atol=1e-9, throw=False
)


def moved(factor, kp, damping, limit, ts):
    """Returns the motion under factor * kp, its critical kd, and factor * damping."""
    kp, damping = factor * kp, factor * damping
    forces = (
        fj.PDController(kp, 2 * jnp.sqrt(kp), limit, TARGET),
        fj.JointDamper(damping),
    )
    forward = diffrax.ForwardMode()
    solution = fj.simulate(arm(), START, ts, forces, adjoint=forward, **IMPLICIT)
    return (solution.q, solution.qd), solution


@partial(jax.jit, **LOOPS)
def motion_and_derivative(kp, damping, limit, ts):
    """Returns a motion and its derivatives in the logarithm of the factor."""
    of = lambda factor: moved(factor, kp, damping, limit, ts)
    _, slopes, solution = jax.jvp(of, (1.0,), (1.0,), has_aux=True)
    return solution, slopes


def test_stiffness_does_not_cost_steps_or_accuracy():
    """Rates grow from 500 to 1e6 per second, explicit steps shrink with them."""
    steps = []
    for kp in STIFFNESSES:
        exact = DRIVEN[f"stiff-{kp:.0e}"]
        solution, (slope, _) = motion_and_derivative(kp, 0.0, np.inf, TS)
        assert solution.outcome == "successful"
        assert np.abs(solution.q[TENTHS] - np.array(exact["q"])).max() <= 1e-6
        right = np.array(exact["dq_dlogkp"])
        assert np.abs(slope[TENTHS] - right).max() <= 1e-4 * np.abs(right).max()
        steps.append(int(solution.stats["num_steps"]))
    assert max(steps) <= 2 * min(steps)


@pytest.mark.slow
def test_the_gradient_in_reverse_mode():
    """Reverse mode goes back through every stage's implicit equations.

    One link without gravity, whose program is the smallest, obeys a linear equation.
    """
    rod = fj.Linkage(
        "R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12], gravity=0
    )
    start, target, inertia = fj.State([-0.5], [0.0]), Hold(jnp.array([-0.4])), 1 / 3

    @partial(jax.jit, **LOOPS)
    @jax.grad
    def gradient(log_kp, ts):
        kp = jnp.exp(log_kp)
        pd = fj.PDController(kp, 2 * jnp.sqrt(kp), jnp.inf, target)
        motion = fj.simulate(rod, start, ts, (pd,), adjoint=ADJOINT, **IMPLICIT)
        return jnp.sum(motion.q)

    # inertia * q'' = kp * (target - q) - 2 sqrt(kp) * q', in the time t sqrt(kp).
    times = np.linspace(0, 20, 11)
    a, b = np.roots([inertia, 2, 1])
    decay = a * b * (np.exp(a * times) - np.exp(b * times)) / (b - a)
    right = np.sum(-0.1 * decay * times / 2)
    for kp in STIFFNESSES:
        ts = np.append(times / np.sqrt(kp), 1.0)
        assert abs(gradient(np.log(kp), ts) - right) <= 1e-4 * abs(right)


def test_an_unstable_step_is_not_taken_for_rounding():
    """The first steps end at 1e17 rad/s, of which rounding errors are large too."""
    kp = 1e7
    controller = fj.PDController(kp, 2 * np.sqrt(kp), np.inf, TARGET)
    motion = fj.simulate(arm(), START, [0, 2e-3], (controller,))
    assert np.abs(motion.q).max() < 1 and np.abs(motion.qd).max() < 1e4


def test_creep_under_heavy_damping():
    """Velocities die at rates of 1e6 to 1e8 per second.

    The balance of damping and gravity remains, 1e-5 rad/s.
    """
    damping = 1e6
    # A gain of 0, and its critical damping, have no derivative.
    solution, (_, slope) = motion_and_derivative(1e-300, damping, np.inf, TS)
    assert solution.outcome == "successful"
    assert solution.stats["num_steps"] <= 1000
    usual = oracle.Arm("RRR", **USUAL, locked=(0,) * 3, base_angle=0, gravity=9.81)
    rows = solution.q[TENTHS], solution.qd[TENTHS], slope[TENTHS]
    for q, qd, change in zip(*rows):
        # Inertia is left out: it makes 1e-11 of a difference.
        with mpmath.workdps(30):
            at_rest = oracle.chain(usual, q.tolist(), [0] * 3)
            _, load, _ = oracle.equations(usual, *at_rest)
            creep = np.array([-float(f) / damping for f in load])
        assert np.abs(qd - creep).max() <= 1e-6 * np.abs(creep).max()
        assert np.abs(change + creep).max() <= 1e-4 * np.abs(creep).max()


def test_chattering_at_a_limit():
    """Efforts leave their limit for microseconds, and are stiff there.

    Each corner is a jump of the derivative inside some step.
    """
    solution, _ = motion_and_derivative(1e6, 0.0, 50.0, 2 * TS)
    assert solution.outcome == "successful"
    assert solution.stats["num_steps"] <= 10_000
    square = np.sum((solution.q - TARGET.target[None]) ** 2, axis=1)
    # By SciPy's DOP853 at 1e-12: 1e-13 gives the same to 2e-11.
    exact = DRIVEN["saturated"]["mean_square"]
    assert np.mean(square) == pytest.approx(exact, rel=1e-6)
