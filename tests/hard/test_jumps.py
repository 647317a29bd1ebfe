"""Scene 24: efforts that jump at times known beforehand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj
from hard.scenes import DRIVEN, START, TIGHT, arm


class Staircase(eqx.Module):
    """A reference of -0.3 rad that rises by 0.2 rad at each of its times."""

    jump_ts: jax.Array

    def __call__(self, t, linkage):
        return jnp.full(3, 0.2 * jnp.sum(t >= self.jump_ts) - 0.3), jnp.zeros(3)


class Pulse(eqx.Module):
    """An effort at the first joint between two times."""

    jump_ts: jax.Array
    effort: jax.Array

    def __call__(self, t, q, qd, linkage):
        on = (t >= self.jump_ts[0]) & (t < self.jump_ts[1])
        return jnp.where(on, self.effort, 0.0) * jnp.array([1.0, 0.0, 0.0])


def test_a_reference_that_steps():
    """No formula of high order holds across a jump.

    Rejections halve the steps down to an undeclared jump; a declared one costs
    nothing.
    """
    jumps = jnp.array([1.0, 2.0, 3.0])
    exact = DRIVEN["stepping"]
    controller = fj.PDController(200.0, 30.0, jnp.inf, Staircase(jumps))
    solution = fj.simulate(
        arm(), START, [0, *exact["ts"]], (controller,), stepsize_controller=TIGHT
    )
    assert np.abs(solution.q[1:] - np.array(exact["q"])).max() <= 1e-8


def test_a_pulse_of_a_microsecond():
    """The pulse lies between the stages of every step that is not told of it."""
    exact = DRIVEN["pulse"]
    pulse = Pulse(jnp.array([7.3, 7.3 + 1e-6]), jnp.array(1e5))

    @eqx.filter_jit
    def motion(pulse):
        return fj.simulate(
            arm(), START, [0, *exact["ts"]], (pulse,), stepsize_controller=TIGHT
        ).q[1:]

    assert np.abs(motion(pulse) - np.array(exact["q"])).max() <= 1e-8
    # The motion depends on the pulse.
    without = motion(eqx.tree_at(lambda p: p.effort, pulse, jnp.array(0.0)))
    assert np.abs(without - np.array(exact["q"])).max() > 1e-3
