"""The gains of a scene's controller: bounds, checks, and derivatives of the loss."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..analysis.tracking import relative_demands
from ..base.checks import instance, is_traced, real_array, shown
from ..linkage.linkage import joint_names
from ..references.reference import reference_of
from ..search.methods import Evaluation
from ..search.simulated import check_scene, sum_of_squares
from ..simulation.scene import Scene
from ..simulation.sensitivities import Sensitivities, sensitivities
from ..simulation.solution import Solution
from .losses import Loss, Tracking, controller_of, gains_of, tip_errors, with_controller

SAMPLES = 1001


def with_gains(scene: Scene, gains: Array) -> Scene:
    """The scene with the rows of `gains` as its controller's kp and kd."""
    controller = controller_of(scene)
    changed = eqx.tree_at(lambda c: (c.kp, c.kd), controller, (gains[0], gains[1]))
    return with_controller(scene, changed)


def gain_sensitivities(
    z: Array, scene: Scene, loss: Loss, tuned: Array
) -> Sensitivities:
    """Residuals of a loss and their derivatives in the log-gains `z` (2n,).

    `tuned` (2, n) says which gains are not zero: zero has no logarithm, and stays.
    """

    def scene_at(z):
        return with_gains(scene, jnp.where(tuned, jnp.exp(z.reshape(tuned.shape)), 0))

    residuals = lambda scene, solution: residuals_of(loss, scene, solution)
    return sensitivities(scene_at, residuals, z, jnp.linspace(0, scene.t1, SAMPLES))


def residuals_of(loss: Loss, scene: Scene, solution: Solution) -> Array:
    """Returns what a loss returns as residuals (m,), whose squares are summed."""
    value = loss(scene, solution)
    size = np.shape(value) if eqx.is_array_like(value) else ()
    value = real_array("loss(scene, solution)", value, size)
    if value.ndim:
        return value.reshape(-1)
    # A scalar loss enters as its square root, whose derivative at 0 does not exist.
    return jnp.where(value == 0, 0, jnp.sqrt(jnp.where(value == 0, 1, value)))[None]


def evaluate_gains(z: Array, problem: tuple[Scene, Loss, Array]) -> Evaluation:
    """Evaluates a scene's loss and its derivatives in the log-gains `z`.

    `problem`: the other arguments of `gain_sensitivities`.
    """
    found = gain_sensitivities(z, *problem)
    _, _, scene, solution = found
    controller = controller_of(scene)
    demands = jnp.abs(relative_demands(controller, scene.linkage, solution))
    # An actuator with a limit of 0 makes no effort, whatever its demand.
    limited = jnp.broadcast_to(jnp.where(controller.limit > 0, 1, 0), demands.shape)
    square_error = jnp.full((), jnp.nan)
    if reference_of(controller.reference).tip is not None:
        square_error = jnp.sum(tip_errors(scene, solution) ** 2)
    return sum_of_squares(
        found,
        saturated=jnp.mean(demands > 1, axis=0),
        effort=jnp.sqrt(jnp.mean(jnp.minimum(demands, limited) ** 2, axis=0)),
        square_error=square_error,
        simulated=jnp.isfinite(solution.q[-1]).all(),
    )


def check_tuned(name: str, scene: Any, loss: Any = tip_errors) -> None:
    """Raises ValueError unless the scene can be tuned by the loss."""
    instance(name, scene, Scene)
    if is_traced(scene):
        raise ValueError(
            f"{name}: expected known values, got {shown(scene)}: gains are tuned "
            "outside of JAX's transformations."
        )
    t1 = real_array(f"{name}.t1", scene.t1, (), above=0)
    check_scene(name, scene, jnp.stack([jnp.zeros_like(t1), t1]))
    reference = controller_of(scene).reference
    if isinstance(loss, Tracking):
        loss.check(scene)
    if isinstance(loss, Tracking) or loss is tip_errors:
        if reference_of(reference).tip is None:
            raise ValueError(
                f"{name}: expected its controller to track a task with a `tip`, which "
                f"the tip error needs, got {shown(reference)}."
            )


def check_alike(name: str, member: Scene, scene: Scene) -> None:
    """Raises ValueError unless both scenes' gains have the same meaning."""
    found, wanted = (
        (joint_names(s.linkage), type(controller_of(s)).__name__)
        for s in (member, scene)
    )
    if found != wanted:
        raise ValueError(
            f"{name}: expected joints and a controller like the scene's, {wanted}, "
            f"got {found}."
        )


def bounds_of(scene: Scene, factor: Any, bounds: Any) -> tuple[np.ndarray, ...]:
    """The start, least and greatest values of kp and kd, (2, n) each."""
    start = gains_of(scene)
    if bounds is None:
        factor = 4.0 if factor is None else factor
        factor = float(real_array("factor", factor, (), above=1))
        return start, start / factor, start * factor
    if factor is not None:
        raise ValueError(f"factor: expected none beside bounds, got {shown(factor)}.")
    if not isinstance(bounds, tuple | list | np.ndarray) or len(bounds) != 2:
        raise ValueError(f"bounds: expected (lower, upper), got {shown(bounds)}.")
    lower, upper = (
        np.asarray(real_array(f"bounds[{i}]", b, start.shape, minimum=0))
        for i, b in enumerate(bounds)
    )
    if not ((lower <= start) & (start <= upper)).all():
        raise ValueError(
            "bounds: expected the scene's gains between them, got "
            f"{lower.tolist()} and {upper.tolist()} around {start.tolist()}."
        )
    if (lower[start > 0] == 0).any():
        raise ValueError("bounds: expected positive least gains, got 0.")
    return start, np.where(start > 0, lower, 0), np.where(start > 0, upper, 0)
