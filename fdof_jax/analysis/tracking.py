"""Measures of tracking: saturation and the tip's deviation."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from ..control.pd import PDController
from ..linkage.linkage import Linkage
from ..mechanics.kinematics import tip_position
from ..references.circle import CircleTask
from ..simulation.solution import Solution


@eqx.filter_jit
def saturated(
    controller: PDController, linkage: Linkage, solution: Solution
) -> Bool[Array, "time joint"]:
    """Returns whether each actuator is at its limit, along a motion.

    **Arguments:** `controller`; `linkage`; `solution`: a motion under the controller.
    """
    demand = jax.vmap(controller.demand, in_axes=(0, 0, 0, None))(
        solution.ts, solution.q, solution.qd, linkage
    )
    return jnp.abs(demand) > controller.limit[None]


@eqx.filter_jit
def tip_deviation(
    linkage: Linkage, task: CircleTask, solution: Solution
) -> Float[Array, "time 2"]:
    """Vectors from the commanded to the actual tip along a motion [m].

    **Arguments:** `linkage`; `task`: anything with `tip(t)`; `solution`.
    """
    actual = jax.vmap(tip_position, in_axes=(None, 0))(linkage, solution.q)
    return actual - jax.vmap(task.tip)(solution.ts)
