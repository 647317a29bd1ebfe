"""Causes of failed motions, in words; looked for only after a failure."""

import inspect
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..forces.element import Element, ForeignElement
from ..linkage.linkage import Linkage, joint_names
from ..steps.derivative_control import linearised
from .field import (
    args_of,
    element_effort,
    initial_own,
    initial_states,
    whole,
    with_states,
)
from .integrate import Inputs
from .prescribed import formulation
from .solution import OUTCOMES, Solution
from .solve import solve

# An explicit method of order 8 is stable for steps up to some 3 to 6 times the time
# scale of a mode. Where accuracy decides, steps are shorter than twice that.
_STABLE = 2.0


def cause(inputs: Inputs, keywords: dict[str, Any], solution: Solution) -> str:
    """Returns what is known about a failed solve, in a sentence."""
    linkage, (q, qd), ts, own0, forces = inputs
    outcome = str(solution.outcome)
    if outcome == "not finite":
        own = own0 or initial_states(linkage, forces)
        for k, element, state in with_states(forces, own):
            effort, _ = element_effort(k, element, ts[0], q, qd, linkage, state)
            if not np.isfinite(effort).all():
                return f"The effort of forces[{k}] is not finite at the start."
    if outcome in ("out of steps", "tolerance out of reach"):
        return _of_steps(inputs, keywords, solution)
    return _of_joints(linkage, solution) + OUTCOMES[outcome]


def _of_joints(linkage: Linkage, solution: Solution) -> str:
    """Names the last joint that was held or let go, if any was."""
    if solution.events is None or not (table := solution.events.table)["joint"].size:
        return ""
    joint, event = table["joint"][-1], table["event"][-1]
    return f"Last, joint {joint_names(linkage)[joint - 1]} {event}. "


def _of_steps(inputs: Inputs, keywords, solution: Solution) -> str:
    """Compares the steps of a motion with the fastest mode where it stopped."""
    linkage, _, ts, _, forces = inputs
    steps = int(solution.stats["num_steps"])
    covered = float(solution.stats["time_reached"] - ts[0])
    if covered == 0:
        return "Not one of them met the tolerance."
    mean = covered / max(int(solution.stats["num_accepted_steps"]), 1)
    # A little earlier, as rounding may shift the last step.
    share = 1 - 1e3 * float(jnp.finfo(ts.dtype).eps)
    before = jnp.stack([ts[0], ts[0] + share * covered])
    motion, _ = solve(inputs._replace(ts=before), keywords)
    last = jax.tree.map(lambda rows: rows[-1], (motion.q, motion.qd, motion.own))
    fastest = _fastest_mode(linkage, forces, before[-1], *last)
    rate, grows = abs(fastest), fastest.real > abs(fastest) / 2
    implicit = isinstance(keywords["solver"], diffrax.AbstractImplicitSolver)
    if grows and rate * mean > _STABLE:
        return (
            f"There the motion grows by a rate of {rate:.3g}/s, as under a force that "
            "feeds itself: it diverges, and more max_steps hardly help."
        )
    if solution.outcome != "out of steps":
        return OUTCOMES[str(solution.outcome)]
    if rate * mean > _STABLE and not implicit:
        return (
            f"A mode of {rate:.3g}/s keeps the steps of an explicit method at "
            f"{mean:.2g} s, whatever the tolerance: such a stiff arm needs an implicit "
            "solver (solver=diffrax.Kvaerno5())."
        )
    needed = float(f"{steps * float(ts[-1] - ts[0]) / covered:.2g}")
    return (
        f"At {mean:.2g} s a step, the whole time takes some {needed:,.0f} steps: "
        "raise max_steps, or loosen the tolerance (rtol, atol)."
    )


def _fastest_mode(*scene_and_state: Any) -> complex:
    """Returns the fastest eigenvalue of the linearised equations [1/s], or 0."""
    try:
        modes = np.linalg.eigvals(_linearised(*scene_and_state))
    except Exception:  # of a user's function without derivatives, or not finite
        return 0j
    return complex(modes[np.argmax(np.abs(modes))])


@eqx.filter_jit
def _linearised(
    linkage: Any, forces: tuple[Element, ...], t: Array, q: Array, qd: Array, own: Any
) -> Array:
    """Returns the matrix of the linearised equations of first order."""
    args, (term, start_of, _) = args_of(linkage, q, forces), formulation(forces)
    start = whole(*start_of(args, qd), initial_own(args, own))
    return linearised(term, t, start, args)


def check_arguments(forces: tuple[Element, ...]) -> None:
    """Raises TypeError for a plain function that cannot be called as an element."""
    for k, element in enumerate(forces):
        if isinstance(element, ForeignElement) and inspect.isfunction(element.called):
            try:
                inspect.signature(element.called).bind("t", "q", "qd", "linkage")
            except TypeError as error:
                raise TypeError(
                    f"forces[{k}]: expected a function (t, q, qd, linkage) -> tau, got "
                    f"one with other arguments: {error}."
                ) from None
