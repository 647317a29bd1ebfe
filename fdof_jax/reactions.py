"""Bearing reactions: what the links do to one another in the joints."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from .actuators import LinearActuator
from .dynamics import forward_dynamics
from .forces import Forces
from .kinematics import joint_positions, mass_center_velocities, mass_centers
from .linkage import Linkage
from .points import PointElement
from .simulation import joint_efforts
from .solution import Solution


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _loads(
    linkage: Linkage, forces: Forces, t: Any, q: Array, qd: Array, qdd: Array
) -> tuple[Array, Array]:
    """On the ground and the links: forces, and moments about the ground pivot."""
    force, moment = jnp.zeros((4, 2)), jnp.zeros(4)
    for element in forces:
        loads = ()
        if isinstance(element, PointElement):
            loads = element.loads(t, q, qd, linkage)
        elif isinstance(element, LinearActuator):
            loads = element.loads(t, q, qd, qdd, linkage)
        for point, push, turn in loads:
            place = point.position(linkage, q)
            force = force.at[point.link].add(push)
            moment = moment.at[point.link].add(turn + _cross(place, push))
    return force, moment


def _reactions(
    linkage: Linkage, forces: Forces, t: Array, q: Array, qd: Array, tau: Array
) -> Array:
    qdd = forward_dynamics(linkage, q, qd, tau, forces)
    motion = lambda q, qd: mass_center_velocities(linkage, q, qd)
    _, (acceleration, spin_up) = jax.jvp(motion, (q, qd), (qd, qdd))
    weight = jnp.array([[0.0, 1.0]]) * linkage.gravity
    needed = linkage.mass[:, None] * (acceleration + weight)
    turning = linkage.inertia * spin_up + _cross(mass_centers(linkage, q), needed)
    force, moment = _loads(linkage, forces, t, q, qd, qdd)
    # Each joint carries all links beyond it.
    beyond = lambda rows: jnp.cumsum(rows[::-1], axis=0)[::-1]
    carried, about_pivot = beyond(needed - force[1:]), beyond(turning - moment[1:])
    about = about_pivot - _cross(joint_positions(linkage, q), carried)
    return jnp.concatenate([carried, about[:, None]], axis=1)


def joint_reactions(
    linkage: Linkage, forces: Forces, solution: Solution
) -> Float[Array, "time joint 3"]:
    """What each joint's bearing does to the link beyond it, along a motion.

    From the balances of Newton and Euler, link by link from the tip. Where a joint is
    free to move, this is the effort that passes through it: of dampers, controllers,
    drives and armatures; loads on points act on the links themselves.

    **Arguments:** the linkage, the forces and the solution of one `simulate`.

    **Returns:** force (x, y) [N] and moment [N m] on the moving link, at its
    characteristic point (see `joint_positions`). The link before takes the opposite.

    **Raises:** ValueError if `forces` is not a tuple of force elements.
    """
    efforts = joint_efforts(linkage, forces, solution)
    return _along(linkage, forces, solution, efforts.total)


@eqx.filter_jit
def _along(linkage, forces, solution, total) -> Array:
    motion = solution.ts, solution.q, solution.qd, total
    return jax.vmap(lambda *m: _reactions(linkage, forces, *m))(*motion)
