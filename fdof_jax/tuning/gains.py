"""The gains of a scene's controller: bounds, checks, and derivatives of the loss."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..checks import instance, is_traced, place_of, real_array
from ..forces.element import elements
from ..linkage.coordinates import real_state
from ..linkage.linkage import check_linkage, joint_names
from ..references.reference import reference_of
from ..search.methods import Evaluation
from ..simulation.scene import Scene
from ..simulation.sensitivities import sensitivities
from ..simulation.simulate import check_elements
from ..simulation.solution import Solution
from .losses import Tracking, controller_of, relative_demands, tip_errors

Loss = Callable[[Scene, Solution], Array]
SAMPLES = 1001


def with_gains(scene: Scene, gains: Array) -> Scene:
    """The scene with the rows of `gains` as its controller's kp and kd."""
    controller = controller_of(scene)
    index = place_of(controller, scene.forces)
    controller = eqx.tree_at(lambda c: (c.kp, c.kd), controller, (gains[0], gains[1]))
    forces = (*scene.forces[:index], controller, *scene.forces[index + 1 :])
    return scene._replace(forces=forces)


def evaluate_gains(z: Array, problem: tuple[Scene, Loss, Array]) -> Evaluation:
    """Evaluates one member's loss and its derivatives in the log-gains `z`.

    `problem`: the scene, the loss, and a mask of the tuned gains.
    """
    scene, loss, tuned = problem

    def scene_at(z):
        # A gain of zero has no logarithm: it stays zero.
        return with_gains(scene, jnp.where(tuned, jnp.exp(z.reshape(2, 3)), 0))

    def residuals(scene, solution):
        value = loss(scene, solution)
        size = np.shape(value) if eqx.is_array_like(value) else ()
        value = real_array("loss(scene, solution)", value, size)
        if value.ndim:
            return value.reshape(-1)
        # Residuals are squared, so a scalar loss enters as its square root, whose
        # derivative at 0 does not exist.
        return jnp.where(value == 0, 0, jnp.sqrt(jnp.where(value == 0, 1, value)))[None]

    ts = jnp.linspace(0, scene.t1, SAMPLES)
    value, jacobian, trial, solution = sensitivities(scene_at, residuals, z, ts)
    demands = jnp.abs(relative_demands(trial, solution))
    # An actuator with a limit of 0 makes no effort, whatever its demand.
    limited = jnp.where(controller_of(trial).limit > 0, 1, 0)[None]
    square_error = jnp.full((), jnp.nan)
    if reference_of(controller_of(trial).reference).tip is not None:
        square_error = jnp.sum(tip_errors(trial, solution) ** 2)
    facts = dict(
        saturated=jnp.mean(demands > 1, axis=0),
        effort=jnp.sqrt(jnp.mean(jnp.minimum(demands, limited) ** 2, axis=0)),
        square_error=square_error,
        simulated=jnp.isfinite(solution.q[-1]).all(),
        steps=solution.stats["num_steps"],
    )
    return Evaluation(
        jnp.sum(value**2), 2 * jacobian.T @ value, 2 * jacobian.T @ jacobian, facts
    )


def check_tuned(name: str, scene: Any, loss: Any) -> None:
    """Raises ValueError unless the scene can be tuned by the loss."""
    instance(name, scene, Scene)
    if is_traced(scene):
        raise ValueError(
            f"{name}: expected known values, got {scene!r}: gains are tuned outside of "
            "JAX's transformations."
        )
    check_linkage(scene.linkage)
    real_state(f"{name}.state0", scene.state0, scene.linkage)
    t1 = real_array(f"{name}.t1", scene.t1, (), above=0)
    elements(f"{name}.forces", scene.forces)
    controller = controller_of(scene)
    check_elements(scene.forces, scene.linkage, jnp.stack([jnp.zeros_like(t1), t1]))
    if isinstance(loss, Tracking):
        loss.check(scene)
    if isinstance(loss, Tracking) or loss is tip_errors:
        if reference_of(controller.reference).tip is None:
            raise ValueError(
                "loss: expected one of your own, because the reference has no `tip` "
                f"for the tip error, got {controller.reference!r}."
            )


def check_alike(name: str, member: Scene, scene: Scene) -> None:
    """Raises ValueError unless both scenes' gains have the same meaning."""
    kinds = [
        (joint_names(s.linkage), type(controller_of(s)).__name__)
        for s in (member, scene)
    ]
    if kinds[0] != kinds[1]:
        raise ValueError(
            f"{name}: expected joints and a controller like the scene's, {kinds[1]}, "
            f"got {kinds[0]}."
        )


def bounds_of(scene: Scene, factor: Any, bounds: Any) -> tuple[np.ndarray, ...]:
    """The start, least and greatest values of kp and kd, (2, 3) each."""
    controller = controller_of(scene)
    start = np.stack([np.asarray(controller.kp), np.asarray(controller.kd)])
    if bounds is None:
        factor = 4.0 if factor is None else factor
        factor = float(real_array("factor", factor, (), above=1))
        return start, start / factor, start * factor
    if factor is not None:
        raise ValueError(f"factor: expected none beside bounds, got {factor!r}.")
    if not isinstance(bounds, tuple | list | np.ndarray) or len(bounds) != 2:
        raise ValueError(f"bounds: expected (lower, upper), got {bounds!r}.")
    lower, upper = (
        np.asarray(real_array(f"bounds[{i}]", b, (2, 3), minimum=0))
        for i, b in enumerate(bounds)
    )
    if not (lower <= upper).all():
        raise ValueError(
            "bounds: expected the least gains before the greatest, got "
            f"{lower.tolist()} and {upper.tolist()}."
        )
    if not ((lower <= start) & (start <= upper)).all():
        raise ValueError(
            "bounds: expected the scene's gains between them, got "
            f"{lower.tolist()} and {upper.tolist()} around {start.tolist()}."
        )
    if (lower[start > 0] == 0).any():
        raise ValueError("bounds: expected positive least gains, got 0.")
    return start, np.where(start > 0, lower, 0), np.where(start > 0, upper, 0)
