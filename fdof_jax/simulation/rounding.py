"""Step control that does not chase rounding errors, and the accuracy that they leave.

Equations that lose accuracy amplify rounding errors in the rates. The error estimate of
a step is then this noise times the step size: no shorter step brings it below a tight
tolerance, and steps that try reach nothing.
"""

import functools
from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ..linkage.topology import real_joints
from .dopri8 import Health, constant
from .step_wrappers import Adaptive

# Rounding errors of an acceleration, over its size times eps and the loss of accuracy:
# less for slides, whose inertia is a sum of masses without levers.
_OF_REVOLUTE, _OF_SLIDE = 1.0, 0.5
# An error estimate sums the noise of all stages. Up to so many rounding errors it
# neither rejects a step nor shortens the next, and below a part of one, or of the
# tolerance if that is larger, the next step may be longer.
_DOUBTFUL, _HELD = 8.0, 0.43


class AboveRounding(Adaptive):
    """A controller that does not chase rounding errors."""

    controller: Any

    def adapt_step_size(self, *arguments):
        t0, t1, y0, y1_candidate, args, (error, health), *rest = arguments
        order, _ = rest
        # The error over its tolerance after which the next step is as long.
        same_step = _safety(self.controller) ** order
        revolute = real_joints(args.linkage.ef)
        of_qd = _rounding(revolute, health, y0, y1_candidate)
        of_delta = jax.tree.map(lambda noise: jnp.abs(t1 - t0) * noise, of_qd)

        def judged(error: Array, start: Array, end: Array, rounding: Array) -> Array:
            size = jnp.maximum(jnp.abs(start), jnp.abs(end))
            tolerance = self.atol + self.rtol * size  # as diffrax's controller has it
            met, found = rounding > tolerance, jnp.abs(error)
            # In healthy equations the division is by a tolerance and has no effect.
            ratio = found / jnp.where(met, rounding, tolerance)
            noise = found < _DOUBTFUL * rounding
            held = same_step * jnp.minimum(ratio / _HELD, 1)
            beyond = ratio / jnp.where(met, _DOUBTFUL, 1)
            lessened = jnp.where(noise, held, beyond)
            return jnp.where(met | noise, tolerance * lessened, error)

        # The elements' own states come last; their rates do not lose accuracy.
        ends, noise = (y0[:2], y1_candidate[:2]), (of_delta, of_qd)
        motion = jax.tree.map(judged, error[:2], *ends, noise)
        error = (*motion, *error[2:])
        return super().adapt_step_size(t0, t1, y0, y1_candidate, args, error, *rest)


def _safety(controller: Any) -> Any:
    """Returns the factor by which a PID controller lessens the steps it chooses."""
    while isinstance(controller, Adaptive):
        controller = controller.controller
    return controller.safety if isinstance(controller, diffrax.PIDController) else 0.9


def _rounding(revolute: Sequence[Array], health: Health, y0: Any, y1: Any) -> Any:
    """Estimates the rounding errors of a step in each velocity or momentum.

    A velocity changes by its acceleration, and its direction turns with the links.
    Joints that lose accuracy disturb those that do not.
    """
    joints: Any = tuple(revolute), health
    if eqx.is_array(y0[1]):
        joints = tuple(map(jnp.stack, joints))
    revolute, losses = joints
    shift, change = jax.tree.map(lambda a, b: jnp.abs(b - a), y0[:2], y1[:2])
    turned = jax.tree.map(lambda r, step: jnp.where(r, step, 0), revolute, shift)
    turned = sum(map(jnp.sum, jax.tree.leaves(turned)))
    size = jnp.maximum(_largest(change), turned * _largest(y0[1]))
    worst = jnp.finfo(size.dtype).eps * jnp.sqrt(_largest(losses)) * size

    def noise(revolute: Array, loss: Array) -> Array:
        return jnp.where(revolute, _OF_REVOLUTE, _OF_SLIDE) * jnp.sqrt(loss) * worst

    return jax.tree.map(noise, revolute, losses)


def _largest(tree: Any) -> Array:
    sizes = [jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]
    return functools.reduce(jnp.maximum, sizes)


class Recorded(Adaptive):
    """A controller whose state includes the largest loss of accuracy so far."""

    controller: Any

    def init(self, *arguments):
        first, state = super().init(*arguments)
        return first, (state, jnp.zeros_like(first))

    def adapt_step_size(self, *arguments):
        *arguments, (state, largest) = arguments
        loss = constant(functools.reduce(jnp.maximum, arguments[5].health))
        keep, *step, state, result = super().adapt_step_size(*arguments, state)
        largest = jnp.where(keep, jnp.maximum(largest, loss), largest)
        return keep, *step, (state, largest), result
