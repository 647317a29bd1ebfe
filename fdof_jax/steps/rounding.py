"""Step control that does not chase rounding errors, and how far they are amplified.

Equations that lose accuracy amplify rounding errors in the rates. The error estimate of
a step is then this noise times the step size: no shorter step brings it below a tight
tolerance, and steps that try reach nothing.
"""

import functools
from collections.abc import Sequence

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

from ..linkage.topology import real_joints
from .controllers import Judging
from .dopri8 import Arguments, Estimate, Health, Integrated

# Rounding errors of an acceleration, over its size times eps and the loss of accuracy:
# less for slides, whose inertia is a sum of masses without levers.
_OF_REVOLUTE, _OF_SLIDE = 1.0, 0.5
# An error estimate sums the noise of all stages: below so many rounding errors it
# neither rejects a step nor shortens the next.
_NOISE = 8.0
# Of the rounding error, or of the tolerance if that is larger: noise beyond this part
# leaves the next step as long, and less noise lets it be longer.
_HELD = 0.43


def above_rounding(
    control: Judging,
    h: Array,
    y0: Integrated,
    y1: Integrated,
    args: Arguments,
    estimate: Estimate,
    of_derivatives: Array | None,
    order: float | None,
) -> PyTree:
    """Returns the error of a step of length `h` without what is rounding.

    `of_derivatives`: the error of derivatives over their tolerance, which counts too.
    """
    error, health, _ = estimate
    same_step = _same_step(control, order)
    of_qd = _rounding(real_joints(args.linkage.ef), health, y0, y1)
    of_delta = jax.tree.map(lambda noise: jnp.abs(h) * noise, of_qd)

    def judged(error: Array, start: Array, end: Array, rounding: Array) -> Array:
        size = jnp.maximum(jnp.abs(start), jnp.abs(end))
        tolerance = control.atol + control.rtol * size  # as diffrax's controller has it
        out_of_reach, error_size = rounding > tolerance, jnp.abs(error)
        ratio = error_size / jnp.where(out_of_reach, rounding, tolerance)
        is_noise = error_size < _NOISE * rounding
        as_long = same_step * jnp.minimum(ratio / _HELD, 1)
        above_noise = ratio / jnp.where(out_of_reach, _NOISE, 1)
        judged_as = tolerance * jnp.where(is_noise, as_long, above_noise)
        error = jnp.where(out_of_reach | is_noise, judged_as, error)
        if of_derivatives is None:
            return error
        # A step that is not finite has no tolerance, and an infinite error.
        return jnp.fmax(jnp.abs(error), of_derivatives * tolerance)

    # The elements' own states come last; their rates do not lose accuracy.
    motion = jax.tree.map(judged, error[:2], y0[:2], y1[:2], (of_delta, of_qd))
    return *motion, *error[2:]


def _same_step(controller: Judging, order: ArrayLike | None) -> ArrayLike:
    """Returns the error, over its tolerance, after which the next step is as long."""
    if not isinstance(controller, diffrax.PIDController):
        return _HELD  # what a method of order 8 has with diffrax's safety factor
    if controller.error_order is not None:
        order = controller.error_order
    # Without an order the controller raises an error of its own.
    return _HELD if order is None else controller.safety**order


def _rounding(
    revolute: Sequence[Array], health: Health, y0: Integrated, y1: Integrated
) -> PyTree:
    """Estimates the rounding errors of a step in each velocity or momentum.

    A velocity changes by its acceleration, and its direction turns with the links.
    Joints that lose accuracy disturb those that do not.
    """
    joints: PyTree = tuple(revolute), health
    if eqx.is_array(y0[1]):
        joints = tuple(map(jnp.stack, joints))
    revolute, losses = joints
    shift, change = jax.tree.map(lambda a, b: jnp.abs(b - a), y0[:2], y1[:2])
    turned = jax.tree.map(lambda r, step: jnp.where(r, step, 0), revolute, shift)
    turned = sum(map(jnp.sum, jax.tree.leaves(turned)))
    size = jnp.maximum(largest(change), turned * largest(y0[1]))
    worst = jnp.finfo(size.dtype).eps * jnp.sqrt(largest(losses)) * size

    def noise(revolute: Array, loss: Array) -> Array:
        return jnp.where(revolute, _OF_REVOLUTE, _OF_SLIDE) * jnp.sqrt(loss) * worst

    return jax.tree.map(noise, revolute, losses)


def largest(tree: PyTree) -> Array:
    """Returns the size of the largest number in a tree."""
    sizes = [jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]
    return functools.reduce(jnp.maximum, sizes)
