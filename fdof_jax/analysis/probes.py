"""Motions that probe a controller on its arm, from where the arm rests."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..control.drives import Drive
from ..control.pd import PDController
from ..forces.element import Element, Forces, StatefulElement
from ..linkage.coordinates import State
from ..linkage.fields import Values, field
from ..linkage.linkage import Linkage
from ..references.reference import Reference
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from .tracking import relative_demands

# As of most answers, so that one program serves both.
_SAMPLES = 1001
# A slow joint may take as long to settle as a fast one takes for so many steps.
_STEPS = 2**20


class Probe(Reference):
    """A reference at rest, which steps at a time or swings from the start."""

    base: Values = field(unit="m or rad")
    step: Values = field(unit="m or rad")
    begin: Values = field((), unit="s")
    amplitude: Values = field(unit="m or rad")
    frequency: Values = field((), unit="rad/s")

    @property
    def jump_ts(self) -> Array:
        return self.begin[None]

    def __call__(self, t: Any, linkage: Linkage) -> tuple[Array, Array]:
        swing = jnp.sin(self.frequency * t), jnp.cos(self.frequency * t)
        stepped = self.base + jnp.where(t < self.begin, 0, self.step)
        return (
            stepped + self.amplitude * swing[0],
            self.amplitude * self.frequency * swing[1],
        )


def commanding(element: Any) -> PDController | None:
    """Returns the PD controller that an element is or holds as its command."""
    while isinstance(element, Drive):
        element = element.command
    return element if isinstance(element, PDController) else None


def following(element: Any, reference: Reference) -> Element:
    """Returns the element with another reference of its PD controller."""
    if isinstance(element, PDController):
        return eqx.tree_at(lambda pd: pd.reference, element, reference)
    inner = following(element.command, reference)
    return eqx.tree_at(lambda drive: drive.command, element, inner)


def _moved(
    linkage: Linkage, start: State, ts: np.ndarray, forces: Forces, own: Any
) -> Solution:
    return simulate(linkage, start, ts, forces, own0=own, throw=False, max_steps=_STEPS)


def at_rest(
    linkage: Linkage, controller: Element, forces: Forces, q: Array, time: float
) -> tuple[State, Any]:
    """Returns the state, and the controller's own, to which the arm sags from `q`."""
    start, own = State(q, jnp.zeros_like(q)), None
    if isinstance(controller, StatefulElement):
        own = (controller.initial_state(linkage),)
    ts = np.linspace(0, time, _SAMPLES)
    sagging = _moved(linkage, start, ts, (controller, *forces), own)
    rest = State(sagging.q[-1], sagging.qd[-1])
    if not np.isfinite(np.asarray(rest)).all():
        return start, own
    if own is not None:
        own = jax.tree.map(lambda rows: rows[-1], sagging.own)
    return rest, own


def answer(
    linkage: Linkage,
    controller: Element,
    forces: Forces,
    start: tuple[State, Any],
    probe: Probe,
    ts: np.ndarray,
) -> tuple[Array, Array, Array]:
    """Simulates an answer to a probe: positions, speeds, and demands over limits."""
    led = following(controller, probe)
    motion = _moved(linkage, start[0], ts, (led, *forces), start[1])
    pd = commanding(led)
    assert pd is not None
    return motion.q, motion.qd, relative_demands(pd, linkage, motion)
