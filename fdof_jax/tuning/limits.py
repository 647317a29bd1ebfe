"""Limits on overshoot, settling time, effort and margin, and how far they are met."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..analysis.linearization import checked, equilibrium, loop_matrices
from ..analysis.loops import margins, open_loop
from ..analysis.responses import BAND, samples_of, step_measures
from ..analysis.tracking import demands
from ..control.pd import PDController
from ..forces.element import Element
from ..linkage.fields import Part, Values, field
from ..linkage.linkage import joint_names, moving_joints
from ..references.reference import reference_motion
from ..simulation.scene import Scene
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from .losses import controller_of

# Excesses count by their largest in each span of times and in each band of frequencies:
# one largest of all would jump between peaks, which a search cannot follow.
_SPANS, _BANDS = 13, 8
_FREQUENCIES = 200


class Limits(Part):
    """Limits on the response to a step, for `tune_within`.

    The step of a joint leads from the start of the motion to where the arm rests at the
    last set point. A joint whose limit is infinite (for the margin: 0) has none. Give
    overshoot and settling time only for joints that step.

    **Arguments:** one value per joint or one for all.

    - `overshoot`: greatest excess over the step, as a share of it.
    - `settling_time`: time after which the joint stays within 2 % of the step [s].
    - `effort`: greatest effort that the controller demands [N or N m].
    - `modulus_margin`: least distance of the loop from instability, from 0 to 1, where
      the step ends; see `analysis.Margins`.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> fj.tuning.Limits(overshoot=0.05, settling_time=[0.5, 0.3, 0.3])
    Limits(overshoot=0.05, settling_time=[0.5, 0.3, 0.3], effort=inf, modulus_margin=0)
    """

    overshoot: Values = field(unit="", minimum=0, finite=False, default=jnp.inf)
    settling_time: Values = field(unit="s", minimum=0, finite=False, default=jnp.inf)
    effort: Values = field(unit="N or N m", above=0, finite=False, default=jnp.inf)
    modulus_margin: Values = field(unit="", minimum=0, default=0.0)


def excess(
    limits: Limits, scene: Scene, solution: Solution, with_margins: bool
) -> Array:
    """Largest excesses of a motion over its limits (m,), negative within them.

    Overshoot and deviation are shares of the step, efforts and margins shares of their
    limits. Margins, which take a linearisation of the arm, are left out if no joint's
    is limited. The number of times is a multiple of 13.
    """
    ts, rest = solution.ts, rest_of(scene)
    share, still = step_shares(solution, rest)

    def at(t, share_now, demand):
        over = jnp.where(still, -1, share_now - 1 - limits.overshoot)
        # From the sample before, as the response may settle between both.
        late = (t + ts[1] > limits.settling_time) & ~still
        unsettled = jnp.where(late, jnp.abs(share_now - 1) - BAND, -1)
        return jnp.stack([over, unsettled, jnp.abs(demand) / limits.effort - 1])

    demand = demands(controller_of(scene), scene.linkage, solution)
    along = _largest(jax.vmap(at)(ts, share, demand), _SPANS)
    if not with_margins:
        return along
    controller, others = controller_and_others(scene)
    A, B, C, _ = loop_matrices(scene.linkage, controller, others, rest, scene.t1)
    near = jax.vmap(lambda s: limits.modulus_margin * jnp.abs(s) - 1)
    return jnp.concatenate([along, _largest(near(sensitivity(A, B, C)), _BANDS)])


def _largest(values: Array, blocks: int) -> Array:
    """Returns the largest of each block of rows, at least -1, as one row."""
    parts = values.reshape(blocks, -1, *values.shape[1:])
    return jnp.maximum(parts.max(axis=1), -1).reshape(-1)  # finite without a limit


def controller_and_others(scene: Scene) -> tuple[PDController, tuple[Element, ...]]:
    """Returns the controller of a scene and its other forces."""
    controller = controller_of(scene)
    others = tuple(force for force in scene.forces if force is not controller)
    return controller, checked(scene.linkage, others)


def rest_of(scene: Scene) -> Array:
    """Returns where the arm rests at the last set point (n,) [m or rad], or NaN."""
    reference = controller_of(scene).reference
    last, _ = reference_motion(reference, jnp.asarray(scene.t1), scene.linkage)
    return equilibrium(scene.linkage, last, scene.forces, scene.t1)


def step_shares(solution: Solution, rest: Array) -> tuple[Array, Array]:
    """Returns each joint's change as a share of its step (time, joint).

    Also returns which joints have no step (joint,).
    """
    height = rest - solution.q[0]
    still = height == 0
    height = jnp.where(still, 1, height)
    return jax.vmap(lambda q: (q - solution.q[0]) / height)(solution.q), still


def sensitivity(A: Array, B: Array, C: Array) -> Array:
    """Computes 1 / (1 + L) of each joint's loop (frequency, joint).

    The frequencies reach from far below to far above those of the joints alone.
    """
    n = B.shape[1]
    joints = jnp.arange(n)
    own = jnp.sqrt(jnp.abs(C[joints, joints] * B[n + joints, joints])) + 1e-3
    low, high = jnp.log(0.05 * own.min()), jnp.log(30 * own.max())
    w = jax.lax.stop_gradient(jnp.exp(jnp.linspace(low, high, _FREQUENCIES)))

    def at(w):
        closed = jnp.linalg.solve(1j * w * jnp.eye(len(A)) - A, B + 0j)
        return 1 - jnp.diagonal(C @ closed)

    return jax.vmap(at)(w)


def measured(scene: Scene, limits: Limits) -> Iterator[tuple[str, str, float, float]]:
    """Yields a row of `TunedWithin` per limit, measured as reports measure.

    The motion is sampled as finely as its fastest mode asks for.
    """
    controller, others = controller_and_others(scene)
    moving, t1, rest = moving_joints(scene.linkage), float(scene.t1), rest_of(scene)
    loops: dict[int, Any] = {
        k: open_loop(scene.linkage, rest, controller, k + 1, others, t1) for k in moving
    }
    poles = loops[moving[0]].feedback().poles()
    count = samples_of(t1, np.abs(poles).max())
    ts = np.linspace(0, t1, count + 1)
    motion = simulate(scene.linkage, scene.state0, ts, scene.forces, throw=False)
    shares, _ = map(np.asarray, step_shares(motion, rest))
    height = np.asarray(rest - motion.q[0])
    speeds = np.asarray(motion.qd) / np.where(height == 0, 1, height)
    efforts = np.abs(demands(controller, scene.linkage, motion)).max(axis=0)
    allowed = jax.tree.map(np.asarray, limits)
    for k, loop in loops.items():
        name = joint_names(scene.linkage)[k]
        overshoot, _, settled = step_measures(ts, shares[:, k], speeds[:, k], 1.0)
        found = {
            "overshoot": (allowed.overshoot[k], overshoot),
            "settling time [s]": (allowed.settling_time[k], settled),
            f"effort [{'N m' if name[0] == 'R' else 'N'}]": (
                allowed.effort[k],
                efforts[k],
            ),
        }
        for label, (most, value) in found.items():
            if most < np.inf:
                yield label, name, float(most), float(value)
        if allowed.modulus_margin[k] > 0:
            least = float(allowed.modulus_margin[k])
            yield "modulus margin", name, least, margins(loop).modulus
