"""Measures of tracking: saturation and the tip's deviation."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ..control.pd import PDController
from ..linkage.linkage import Linkage, without_fixed
from ..mechanics.kinematics import tip_position
from ..references.task import TipReference
from ..simulation.solution import Solution


def demands(
    controller: PDController, linkage: Linkage, solution: Solution
) -> Float[Array, "time joint"]:
    """Computes a controller's demands along a motion, 0 at fixed pairs [N or N m]."""
    along = jax.vmap(controller.demand, in_axes=(0, 0, 0, None))
    found = along(solution.ts, solution.q, solution.qd, linkage)
    return without_fixed(linkage, found)


@eqx.filter_jit
def relative_demands(
    controller: PDController, linkage: Linkage, solution: Solution
) -> Float[Array, "time joint"]:
    """The controller's demands over its limits; 0 at fixed pairs and infinite limits.

    Where a limit is 0, a demand other than 0 gives an infinity of its sign.
    """
    demanded = demands(controller, linkage, solution)
    limit = jnp.broadcast_to(controller.limit, demanded.shape)
    beyond = jnp.where(demanded == 0, 0, jnp.sign(demanded) * jnp.inf)
    return jnp.where(limit > 0, demanded / jnp.where(limit > 0, limit, 1), beyond)


@eqx.filter_jit
def tip_deviation(
    linkage: Linkage, task: TipReference, solution: Solution
) -> Float[Array, "time 2"]:
    """Vectors from the commanded to the actual tip along a motion [m].

    **Arguments:** `linkage`; `task`: anything with `tip(t)`; `solution`.
    """
    actual = jax.vmap(tip_position, in_axes=(None, 0))(linkage, solution.q)
    return actual - jax.vmap(task.tip)(solution.ts)
