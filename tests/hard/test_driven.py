"""Scenes 17 to 20 and 24: stiff and saturated control, damping, efforts that jump.

Two programs do most of this: one of an explicit method, and one of an implicit one.
"""

from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR, FORWARD
from modes import LOOPS, jacobian

import fdof_jax as fj
from hard import scenes as hard
from hard.scenes import DRIVEN, START, TARGET, Hold, arm

STILL = np.zeros(3)


class Staircase(eqx.Module):
    """A reference that rises at each of its times."""

    begin: jax.Array
    rise: jax.Array
    jump_ts: jax.Array

    def __call__(self, t, linkage):
        return self.begin + self.rise * jnp.sum(t >= self.jump_ts), jnp.zeros(3)


class Pulse(eqx.Module):
    """An effort at the first joint between two times."""

    jump_ts: jax.Array
    effort: jax.Array

    def __call__(self, t, q, qd, linkage):
        on = (t >= self.jump_ts[0]) & (t < self.jump_ts[1])
        return jnp.where(on, self.effort, 0.0) * jnp.array([1.0, 0.0, 0.0])


@partial(jax.jit, **LOOPS)
def _driven(ts, kp, kd, limit, begin, rise, effort):
    def q(log_kp):
        stairs = Staircase(begin, rise, jnp.array([1.0, 2.0, 3.0]))
        pd = fj.PDController(kp * jnp.exp(log_kp), kd, limit, stairs)
        forces = pd, Pulse(jnp.array([7.3, 7.3 + 1e-6]), effort)
        options = dict(stepsize_controller=hard.TIGHT) | FORWARD
        return fj.simulate(arm(), START, ts, forces, **options).q

    return jax.jvp(q, (0.0,), (1.0,))


def driven(ts, kp=0.0, kd=0.0, limit=np.inf, begin=0.0, rise=0.0, effort=0.0):
    """Returns a motion under a staircase and a pulse, and its derivative in log kp."""
    rows = (np.broadcast_to(row, 3).astype(float) for row in (limit, begin))
    q, slope = _driven(ts, kp, kd, *rows, rise, effort)
    return np.asarray(q), np.asarray(slope)


def test_a_reference_that_steps():
    """Rejections halve the steps down to an undeclared jump; a declared one costs
    nothing."""
    exact = DRIVEN["stepping"]
    q, _ = driven(np.array([0, *exact["ts"]]), 200.0, 30.0, begin=-0.3, rise=0.2)
    assert np.abs(q[1:] - np.array(exact["q"])).max() <= 1e-8


def test_a_pulse_of_a_microsecond():
    """It lies between the stages of every step that is not told of it."""
    exact = np.array(DRIVEN["pulse"]["q"])  # after 4 and 8 s
    ts = np.linspace(0, 8, 11)
    assert np.abs(driven(ts, effort=1e5)[0][[5, 10]] - exact).max() <= 1e-8
    assert np.abs(driven(ts)[0][[5, 10]] - exact).max() > 1e-3


def test_gradients_at_and_beyond_saturation():
    """The derivative jumps at the start, or is 0 because gains change nothing."""
    # The reference demands exactly the efforts that gravity needs, so the arm rests at
    # its limits.
    load = fj.inverse_dynamics(arm(), START.q, STILL, STILL)
    ts = np.linspace(0, 0.2, 11)
    slope = lambda limit, begin: driven(ts, 128.0, 0.0, limit, begin)[1][-1].sum()
    assert np.isfinite(slope(np.abs(load), START.q + load / 128))
    assert slope(1e-3, TARGET.target) == 0
    assert abs(slope(1e9, TARGET.target)) > 1e-3


def test_the_derivative_at_the_limit_is_that_of_one_side():
    """Its mean belongs to no motion."""
    controller = fj.PDController(jnp.full(3, 128.0), 0.0, 32.0, Hold(jnp.full(3, 0.25)))

    def effort(kp):
        changed = eqx.tree_at(lambda c: c.kp, controller, kp)
        return changed(0.0, STILL, STILL, arm())

    share = np.diag(jax.jacfwd(effort)(controller.kp)) / 0.25
    np.testing.assert_array_equal(effort(controller.kp), controller.limit)
    assert (share == 1).all() or (share == 0).all()


STIFFNESSES = [1e4, 1e6, 1e8]
TS, TENTHS = np.linspace(0, 1, 2001), slice(200, None, 200)
# 1e-9 is one digit more than smooth motions need: at 1e-8 derivatives at kp = 1e6 are
# wrong by 7e-4 while the transient dies, and the chattering motion by 2e-6. The first
# step, tried before anything is known of the rates, has to be short: from 1 ms Newton's
# method diverges at kp = 1e8, and derivatives of the root that it did not find raise.
IMPLICIT: dict[str, Any] = dict(
    solver=diffrax.Kvaerno5(), dt0=1e-6, rtol=1e-9, atol=1e-9, throw=False
)


@partial(jax.jit, **LOOPS)
def stiff(kp, damping, limit, ts):
    """Returns a motion, and its derivatives in a factor of kp and damping."""

    def moved(factor):
        gain = factor * kp
        forces = (
            fj.PDController(gain, 2 * jnp.sqrt(gain), limit, TARGET),
            fj.JointDamper(factor * damping),
        )
        solution = fj.simulate(arm(), START, ts, forces, **IMPLICIT, **FORWARD)
        return (solution.q, solution.qd), solution

    _, slopes, solution = jax.jvp(moved, (1.0,), (1.0,), has_aux=True)
    return solution, slopes


def test_stiffness_does_not_cost_steps_or_accuracy():
    """Rates grow from 500 to 1e6 per second, explicit steps shrink with them."""
    steps = []
    for kp in STIFFNESSES:
        exact = DRIVEN[f"stiff-{kp:.0e}"]
        solution, (slope, _) = stiff(kp, 0.0, np.inf, TS)
        assert solution.outcome == "successful"
        assert np.abs(solution.q[TENTHS] - np.array(exact["q"])).max() <= 1e-6
        assert hard.largest_error(slope[TENTHS], exact["dq_dlogkp"]) <= 1e-4
        steps.append(int(solution.stats["num_steps"]))
    assert max(steps) <= 2 * min(steps)


def test_creep_under_heavy_damping():
    """Velocities die at rates of 1e6 to 1e8 per second, to those of the balance of
    damping and gravity: 1e-5 rad/s."""
    damping = 1e6
    # A gain of 0, and its critical damping, have no derivative.
    solution, (_, slope) = stiff(1e-300, damping, np.inf, TS)
    assert solution.outcome == "successful"
    assert solution.stats["num_steps"] <= 1000
    # Inertia is left out: it makes 1e-11 of a difference.
    load = jax.vmap(fj.bias_force, in_axes=(None, 0, None))(arm(), solution.q, STILL)
    creep = -load[TENTHS] / damping
    assert hard.largest_error(solution.qd[TENTHS], creep) <= 1e-6
    assert hard.largest_error(slope[TENTHS], -creep) <= 1e-4


def test_chattering_at_a_limit():
    """Efforts leave their limit for microseconds, and are stiff there.

    Each corner is a jump of the derivative inside some step.
    """
    solution, _ = stiff(1e6, 0.0, 50.0, 2 * TS)
    assert solution.outcome == "successful"
    assert solution.stats["num_steps"] <= 10_000
    square = np.sum((solution.q - TARGET.target[None]) ** 2, axis=1)
    # By SciPy's DOP853 at 1e-12: 1e-13 gives the same to 2e-11.
    exact = DRIVEN["saturated"]["mean_square"]
    assert np.mean(square) == pytest.approx(exact, rel=1e-6)


def test_an_implicit_method_does_not_pass_over_what_is_at_rest():
    """It would cross the 10 s in a few steps, with a wrong derivative."""

    def end(q0):
        options = dict(solver=diffrax.Kvaerno5()) | FORWARD
        return fj.simulate(BAR, fj.State(q0, np.zeros(1)), [0, 10.0], **options).q[-1]

    exact = np.cos(np.sqrt(9.81 * 0.5 / (1 / 3)) * 10)
    assert abs(jacobian(end)(np.array([-np.pi / 2]))[0] - exact) <= 1e-6


def test_an_unstable_step_is_not_taken_for_rounding():
    """The first steps end at 1e40 rad/s, of which rounding errors are large too."""
    scene = hard.free(arm(), START.q, np.array([0, 1e-4]))
    damper = fj.JointDamper(np.full(3, 1e7))
    scene = scene._replace(forces=(scene.forces[0], damper))
    motion = hard.simulate(scene, hard.DEFAULT)
    creep = -fj.bias_force(arm(), START.q, STILL) / 1e7
    np.testing.assert_allclose(motion.qd[-1], creep, rtol=1e-4)
