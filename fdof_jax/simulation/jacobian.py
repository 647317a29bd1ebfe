"""Jacobians of motions in a few parameters, by tangents beside the motion."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree
from numpy.typing import ArrayLike

from ..base.checks import (
    check_known,
    function,
    increasing,
    instance,
    real_array,
    real_numbers,
)
from ..forces.element import elements_on
from ..linkage.coordinates import State, real_state
from ..linkage.linkage import check_linkage
from ..steps.derivative_control import TANGENTS, TangentJudge
from ..steps.tolerances import SINGLE_TOLERANCE, adaptive, of_precision
from .integrate import Inputs, integrate
from .scene import Scene
from .solution import Solution

_OF_TANGENTS = 300.0  # tolerance of tangents over that of the motion


class Sensitivities(NamedTuple):
    """Residuals (m,) [as computed], their Jacobian (m, n), the scene and its motion."""

    residuals: Float[Array, " residual"]
    jacobian: Float[Array, "residual unknown"]
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


def sensitivities(
    scene_at: Callable[[Array], Scene],
    residuals: Callable[[Scene, Solution], Array],
    z: ArrayLike,
    ts: ArrayLike,
    tolerance: float = 1e-5,
) -> Sensitivities:
    """Computes residuals of a simulated scene and their Jacobian in a few unknowns.

    Tangents are integrated beside the motion, as in `tune` and `fit`. For least squares
    of your own, call it in a function that `simulation.jit` compiles.

    **Arguments:**

    - `scene_at`: returns the scene at unknowns (n,).
    - `residuals`: `(scene, solution) -> array` (m,).
    - `z`: the unknowns (n,).
    - `ts`: increasing times (time,) [s].
    - `tolerance`: relative and absolute tolerance of a step in float64. Tangents have
      300 times that, relative to the largest.

    **Returns:** a `Sensitivities`. A motion that fails is NaN from then on.

    **Raises:** ValueError for malformed arguments.
    """
    function("scene_at", scene_at)
    function("residuals", residuals)
    unknowns = real_array("z", z, (None,))
    times = real_numbers("ts", ts, (None,))
    increasing("ts", times)
    times = jnp.asarray(times)
    check_known("tolerance", tolerance)
    tolerance = float(real_numbers("tolerance", tolerance, (), above=0))
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
        instance("scene_at(z)", scene, Scene)
        linkage, state0, forces, _ = scene
        check_linkage(linkage)
        start = State(*map(jnp.asarray, real_state("state0", state0, linkage)))
        inputs = Inputs(linkage, start, times, None, elements_on(linkage, forces))
        solution = integrate(inputs, keywords, derivatives=True, tangents=judge)
        found = residuals(scene, solution)
        return real_array("residuals(scene, solution)", found, (None,)), solution

    directions = jnp.eye(unknowns.size, dtype=unknowns.dtype)
    value, slopes, solution = along_each(at, unknowns, directions)
    return Sensitivities(value, slopes.T, scene_at(unknowns), solution)
