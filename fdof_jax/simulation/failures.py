"""Causes of failed motions, in words; looked for only after a failure."""

import inspect
from typing import Any

import diffrax
import numpy as np

from ..forces.element import Element, ForeignElement
from .field import element_effort, initial_states, with_states
from .solution import Solution

# Steps are tiny if all that are allowed cover less than this part of the time span.
_SMALL_PART = 0.1


def cause(inputs: tuple[Any, ...], solution: Solution) -> str:
    """Returns what is known about a failed solve, in a sentence."""
    linkage, (q, qd), ts, own0, forces = inputs
    if solution.outcome == "not finite":
        own = own0 or initial_states(linkage, forces)
        for k, element, state in with_states(forces, own):
            effort, _ = element_effort(k, element, ts[0], q, qd, linkage, state)
            if not np.isfinite(effort).all():
                return f"The effort of forces[{k}] is not finite at the start."
    covered = solution.stats["time_reached"] - ts[0]
    if solution.outcome == "out of steps" and covered < _SMALL_PART * (ts[-1] - ts[0]):
        return (
            "Where steps are so short, more max_steps hardly help: a stiff arm needs "
            "an implicit solver (solver=diffrax.Kvaerno5()), and a force that feeds "
            "itself diverges."
        )
    return diffrax.RESULTS[solution.result].strip()


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
