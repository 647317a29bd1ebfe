"""Joint efforts along a motion."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from ..base.checks import is_traced, place_of, refusal
from ..base.functions import sharing_functions
from ..forces.element import Element, Forces, ScalarElement, elements_on
from ..linkage.linkage import Linkage, check_linkage, without_fixed
from .holding import changes, efforts_of_holders
from .prescribed import prescribed, prescribed_effort
from .scene import accepts_scene
from .simulate import check_own
from .solution import Solution, check_joints
from .solve import cut, padded
from .vector_field import element_effort, with_states


class Efforts(NamedTuple):
    """Joint efforts along a motion, 0 at fixed pairs [N or N m].

    - `total`: the sum of `elements` (time, n).
    - `elements`: those of each element (element, time, n), also to hold joints or to
      prescribe their motion. Added masses have none, neither weight nor inertia.
    """

    total: Float[Array, "time joint"]
    elements: Float[Array, "element time joint"]


class _Held(ScalarElement):
    """Efforts of sampled control, each held until the next one."""

    begin: Float[Array, " sample"]
    tau: Float[Array, "sample joint"]

    def schedule(self, t, linkage):
        count = jnp.searchsorted(self.begin, t, side="right", method="scan_unrolled")
        return tuple(jnp.where(count > 0, self.tau[count - 1], 0))

    def respond(self, scheduled, q, qd, linkage):
        return scheduled


def acting_in(motion: Solution, forces: tuple[Element, ...]) -> tuple[Element, ...]:
    """Returns the elements that acted: held efforts in the place of a sampled control.

    Raises ValueError for a sampled motion without its control.
    """
    if motion.acting is None:
        return forces
    if not forces:
        raise refusal("forces", "(control, *forces) of a sampled motion", forces)
    return _Held(motion.ts, motion.acting), *forces[1:]


@accepts_scene
def joint_efforts(linkage: Linkage, forces: Forces, solution: Solution) -> Efforts:
    """Computes the joint efforts of the force elements along a motion.

    **Arguments:** the linkage, the forces and the solution of one `simulate`, or
    `joint_efforts(scene, solution)`. After `simulate_sampled`, the forces are
    `(control, *forces)`.

    **Returns:** `Efforts` [N or N m].

    **Raises:** ValueError for malformed arguments, and for a batch (use `jax.vmap`).

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> scene = fj.scenes.fig7()
    >>> motion = fj.simulate(scene, np.linspace(0, 1, 101))
    >>> total, elements = fj.joint_efforts(scene, motion)
    >>> total[0].tolist(), elements.shape
    ([15.873, -300.0, -9.921], (1, 101, 3))
    """
    check_linkage(linkage)
    check_joints("solution", solution, linkage)
    forces = elements_on(linkage, forces)
    if solution.q.ndim != 2:
        raise ValueError(
            "solution: expected one motion (use jax.vmap for a batch), got positions "
            f"of shape {solution.q.shape}."
        )
    forces = acting_in(solution, forces)
    check_own("solution.own", solution.own, forces, linkage, solution.ts.shape)
    rows = solution.ts, solution.q, solution.qd, solution.own
    if not is_traced(linkage, forces, rows):
        run = lambda forces: _efforts(linkage, forces, *padded(rows))
        efforts = sharing_functions(run, forces=forces)
        if not is_traced(efforts):  # by a value in the closure of a function
            elements = np.asarray(efforts.elements)[:, : len(solution.ts)]
            return Efforts(
                cut(efforts.total, len(solution.ts)), jax.device_put(elements)
            )
    return _efforts(linkage, forces, *rows)


@eqx.filter_jit
def _efforts(
    linkage: Linkage, forces: tuple[Element, ...], ts: Array, q: Array, qd: Array, own
) -> Efforts:
    motion_rows, efforts = (ts, q, qd), []
    for index, element, state in with_states(forces, own):

        def effort(t, q, qd, state, index=index, element=element):
            return element_effort(index, element, t, q, qd, linkage, state)

        efforts.append(jax.vmap(effort)(*motion_rows, state))
    stacked = jnp.stack(efforts) if efforts else jnp.zeros((0, *q.shape))
    if changes(forces):
        held = lambda *row: efforts_of_holders(linkage, forces, *row)
        total = jnp.sum(stacked, axis=0)
        stacked += jax.vmap(held, out_axes=1)(*motion_rows, total)
    if (motion := prescribed(forces)) is not None:
        demand = lambda *row: prescribed_effort(linkage, forces, *row)
        demanded = jax.vmap(demand)(*motion_rows, jnp.sum(stacked, axis=0))
        place = place_of(motion, forces)
        stacked = stacked.at[place].set(demanded)
    stacked = without_fixed(linkage, stacked)
    return Efforts(jnp.sum(stacked, axis=0), stacked)
