"""Scene 19: derivatives at the limits of the actuators, and beyond them.

That a tuner reports saturation is tested in tests/test_tuning.py.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj
from fdof_jax.tuning.losses import relative_demands
from hard.scenes import START, TARGET, Hold, arm

STILL = np.zeros(3)
KP = 128.0


def test_the_derivative_at_the_limit_is_that_of_one_side():
    """Demand and limit are equal, so the effort has two one-sided derivatives.

    These are 0 and the demand's derivative; their mean belongs to no motion.
    """
    kp = jnp.full(3, KP)
    controller = fj.PDController(kp, 0.0, 32.0, Hold(jnp.full(3, 0.25)))

    def effort(kp):
        changed = eqx.tree_at(lambda c: c.kp, controller, kp)
        return changed(0.0, jnp.zeros(3), jnp.zeros(3), arm())

    slope = jax.jacfwd(effort)(controller.kp)
    np.testing.assert_array_equal(effort(controller.kp), controller.limit)
    share = np.diag(slope) / 0.25
    assert (share == 1).all() or (share == 0).all()


def end(log_kp, limit, reference):
    """Returns the sum of joint positions after 0.2 s, and the share at the limit."""
    controller = fj.PDController(KP * jnp.exp(log_kp), 0.0, limit, reference)
    ts = np.linspace(0, 0.2, 11)
    adjoint = diffrax.ForwardMode()
    solution = fj.simulate(arm(), START, ts, (controller,), adjoint=adjoint)
    demands = relative_demands(controller, arm(), solution)
    share = jnp.mean(jnp.abs(demands) > 1, axis=0)
    return jnp.sum(solution.q[-1]), share


def test_gradients_at_and_beyond_saturation():
    """The derivative jumps at the start, or is 0 because gains change nothing.

    For reverse mode see tests/test_gradients.py.
    """

    @jax.jit
    def gradient(log_kp, *at):
        of = lambda log_kp: end(log_kp, *at)
        return jax.jvp(of, (log_kp,), (1.0,), has_aux=True)[1:]

    # The reference demands exactly the efforts that gravity needs, so the arm rests at
    # its limits.
    load = fj.inverse_dynamics(arm(), START.q, STILL, STILL)
    resting = Hold(START.q + load / KP)
    demand = fj.PDController(KP, 0.0, jnp.inf, resting).demand(
        0.0, START.q, STILL, arm()
    )
    at_limit, _ = gradient(0.0, np.abs(demand), resting)
    assert np.isfinite(at_limit)
    # Weak actuators: the gains have no effect, and the share is 1.
    weak, share = gradient(0.0, np.full(3, 1e-3), TARGET)
    assert weak == 0 and (share == 1).all()
    strong, share = gradient(0.0, np.full(3, 1e9), TARGET)
    assert abs(strong) > 1e-3 and (share == 0).all()
