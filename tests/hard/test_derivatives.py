"""Scene 28: derivatives of losses at their minimum.

Hessians of a batch (scene 29) are in tests/test_switches.py.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.base.trigonometry import sincos
from fdof_jax.tuning.losses import tip_deviation
from hard.scenes import arm

STILL = np.zeros(3)


def test_losses_at_zero_error():
    """The arm has no error, and the norm of a zero vector has no slope."""
    upright = fj.CircleTask(center=(0.4, 1.0), radius=0.3)
    q = fj.inverse_kinematics(arm(), upright.tip(0.0), upright.orientation)

    def losses(kp, q0, center):
        task = eqx.tree_at(lambda t: t.center, upright, center)
        controller = fj.PDController(kp, 5.0, jnp.inf, task)
        forces = (controller, fj.JointDamper(0.0))
        motion = fj.simulate(arm(), fj.State(q0, STILL), [0, 0.1], forces)
        deviation = tip_deviation(arm(), task, motion)
        squares = jnp.sum(deviation[0] ** 2)
        # NaN in the slope of any of them is NaN in that of the sum.
        return squares + jnp.mean(deviation**2) + jnp.sum(motion.q), squares

    arguments = jnp.full(3, 100.0), q, upright.center
    both = jax.jit(jax.value_and_grad(losses, (0, 1, 2), has_aux=True), **LOOPS)
    (_, squares), slopes = both(*arguments)
    assert abs(squares) < 1e-28
    for slope in slopes:
        assert np.isfinite(slope).all()


def everything(linkage, q, qd):
    return dict(
        tip=fj.tip_position(linkage, q),
        x=fj.paper.to_chain(linkage, q, qd),
        centres=fj.mass_centers(linkage, q),
        energy=fj.energy(linkage, q, qd),
        qdd=fj.forward_dynamics(linkage, q, qd, STILL),
        conditioning=fj.analysis.inertia_ratios(linkage, q),
        angles=sincos(q),
    )


slopes = jax.jit(jax.jacrev(everything, (1, 2)), **LOOPS)


@pytest.mark.filterwarnings("ignore:prismatic joints .* are parallel")
@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_kinematics_where_everything_is_zero(topology):
    """The arm is straight along the x axis, at rest: atan2, roots and norms of 0."""
    zeros = jnp.zeros(3)
    for leaf in jax.tree.leaves(slopes(arm(topology), zeros, zeros)):
        assert np.isfinite(leaf).all()


def test_a_circle_of_no_radius():
    """The bearing from the centre to itself is atan2(0, 0)."""
    still = fj.CircleTask(center=(0.4, 1.0), radius=0.0)

    def reference(task):
        return task(0.3, arm())

    for leaf in jax.tree.leaves(jax.jit(jax.jacfwd(reference))(still)):
        assert np.isfinite(leaf).all()
