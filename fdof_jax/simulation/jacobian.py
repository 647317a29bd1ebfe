"""Jacobians of motions in a few parameters, by tangents beside the motion."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from ..forces.element import elements
from ..linkage.coordinates import State
from ..steps.derivative_control import TANGENTS, TangentJudge
from ..steps.tolerances import SINGLE_TOLERANCE, adaptive, of_precision
from .integrate import Inputs, integrate
from .scene import Scene
from .solution import Solution

# Tolerance of each step, and that of its tangents over it. Fig 7's mean squared error
# of the tip is then right to 1e-7 of itself, and its gradient in six gains too.
TOLERANCE, _OF_TANGENTS = 1e-5, 300.0


class Sensitivities(NamedTuple):
    """Residuals (m,) and their Jacobian (m, n), with the scene and its motion."""

    residuals: Array
    jacobian: Array
    scene: Scene
    solution: Solution


def along_each(
    function: Callable[[Array], tuple[PyTree, PyTree]], z: Array, directions: Array
) -> tuple[PyTree, PyTree, PyTree]:
    """Returns a value, its derivatives along directions, and what comes with it.

    `function(z)` returns the value and the rest.
    """

    def along(direction):
        return jax.jvp(function, (z,), (direction,), has_aux=True)

    each = jax.vmap(along, out_axes=(None, 0, None), axis_name=TANGENTS)
    return each(directions)


def jacobian_of(
    scene_at: Callable[[Array], Scene],
    residuals: Callable[[Scene, Solution], Array],
    z: Array,
    ts: Array,
    tolerance: float = TOLERANCE,
) -> Sensitivities:
    """Computes residuals of a simulated scene and their Jacobian in `z` (n,).

    A motion that fails is NaN from then on.

    **Arguments:** `scene_at`: maps `z` to a scene; `residuals`: maps the scene and its
    motion at the times `ts` to an array; `tolerance`: relative and absolute tolerance
    of a step in float64. Tangents have 100 times that, relative to the largest.
    """
    tolerance = of_precision(tolerance, max(tolerance, SINGLE_TOLERANCE))
    keywords: dict[str, Any] = dict(
        solver=None,
        stepsize_controller=adaptive(tolerance, tolerance),
        dt0=1e-3,
        adjoint=diffrax.ForwardMode(),
        max_steps=65536,
        progress_meter=diffrax.NoProgressMeter(),
    )

    judge = TangentJudge(_OF_TANGENTS * tolerance)

    def at(z):
        scene = scene_at(z)
        start = State(*(jnp.asarray(a, dtype=float) for a in scene.state0))
        forces = elements("scene.forces", scene.forces)
        inputs = Inputs(scene.linkage, start, ts, None, forces)
        solution = integrate(inputs, keywords, derivatives=True, tangents=judge)
        return residuals(scene, solution), solution

    value, slopes, solution = along_each(at, z, jnp.eye(z.size, dtype=z.dtype))
    return Sensitivities(value, slopes.T, scene_at(z), solution)
