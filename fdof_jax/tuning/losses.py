"""Losses for gain tuning: tip error, effort, rate of effort."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..analysis.tracking import relative_demands, tip_deviation
from ..base.checks import instance, real_array, refusal
from ..control.pd import PDController
from ..linkage.linkage import without_fixed
from ..references.reference import reference_motion, reference_of
from ..simulation.sampled import check_joints
from ..simulation.scene import Scene
from ..simulation.solution import Solution

Loss = Callable[[Scene, Solution], Array]


def controller_of(scene: Scene) -> PDController:
    """The PD controller of a scene; raises ValueError unless there is exactly one."""
    found = [force for force in scene.forces if isinstance(force, PDController)]
    if len(found) != 1:
        kinds = ", ".join(type(force).__name__ for force in scene.forces)
        raise ValueError(
            "scene: expected exactly one PDController among its forces (not one within "
            f"a drive or a PIDController), got {len(found)} among ({kinds})."
        )
    return found[0]


def with_controller(scene: Scene, element: Any) -> Scene:
    """The scene with another force element in place of its controller."""
    controller = controller_of(scene)
    forces = (element if force is controller else force for force in scene.forces)
    return scene._replace(forces=tuple(forces))


def gains_of(scene: Scene) -> Any:
    """kp and kd of a scene's controller (2, n), 0 at fixed pairs."""
    controller = controller_of(scene)
    gains = controller.kp, controller.kd
    return jnp.stack([without_fixed(scene.linkage, value) for value in gains])


def tip_errors(scene: Scene, solution: Solution) -> Float[Array, " residual"]:
    """Tip errors at the output times, scaled so that their squares sum to the mean.

    **Arguments:**

    - `scene`: its PD controller must track a task with a `tip`.
    - `solution`: the scene's motion.

    **Returns:** x and y components [m], divided by the root of the number of times.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, forces, _ = fj.scenes.fig7()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101), forces)
    >>> errors = fj.tuning.tip_errors(fj.scenes.fig7(), motion)
    >>> float((errors**2).sum() ** 0.5)  # rms over the first second [m]
    0.351
    """
    instance("scene", scene, Scene)
    instance("solution", solution, Solution)
    check_joints("solution", solution, scene.linkage)
    task: Any = controller_of(scene).reference
    if reference_of(task).tip is None:
        raise refusal("scene", "a controller of a task with a `tip`", task)
    deviation = tip_deviation(scene.linkage, task, solution)
    return deviation.reshape(-1) / solution.ts.size**0.5


def joint_errors(scene: Scene, solution: Solution) -> Float[Array, " residual"]:
    """Joint errors at the output times, scaled so that their squares sum to the mean.

    This is a loss for controllers whose reference has no `tip`. It adds errors of
    slides [m] and angles [rad] as they are.

    **Arguments:**

    - `scene`: must hold exactly one `PDController`.
    - `solution`: the scene's motion.

    **Returns:** q - q_ref [m or rad], divided by the root of the number of times.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, forces, _ = fj.scenes.fig7()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101), forces)
    >>> errors = fj.tuning.joint_errors(fj.scenes.fig7(), motion)
    >>> float((errors**2).sum() ** 0.5)  # rms over the first second
    0.097
    """
    instance("scene", scene, Scene)
    instance("solution", solution, Solution)
    check_joints("solution", solution, scene.linkage)
    reference = controller_of(scene).reference
    commanded = lambda t: reference_motion(reference, t, scene.linkage)[0]
    errors = solution.q - jax.vmap(commanded)(solution.ts)
    errors = without_fixed(scene.linkage, errors)
    return errors.reshape(-1) / solution.ts.size**0.5


class Tracking(eqx.Module):
    """Mean squared tip error plus prices of effort, a loss for `tune`.

    The loss adds effort * mean((tau / limit)^2) and
    effort_rate * mean((d(tau / limit)/dt)^2), each summed over the joints. Rates are
    differences between output times, a thousandth of the run apart.

    **Arguments:**

    - `effort`: price of full effort of one joint all the time [m^2].
    - `effort_rate`: price of a change by the full effort per second [m^2 s^2].

    **Raises:** ValueError for malformed or negative prices.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, forces, _ = fj.scenes.fig7()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101), forces)
    >>> residuals = fj.tuning.Tracking(effort=0.1)(fj.scenes.fig7(), motion)
    >>> float((residuals**2).sum())  # [m^2]
    0.15
    """

    effort: Float[Array, ""]
    effort_rate: Float[Array, ""]

    def __init__(self, effort: ArrayLike = 0.0, effort_rate: ArrayLike = 0.0):
        self.effort = real_array("effort", effort, (), minimum=0)
        self.effort_rate = real_array("effort_rate", effort_rate, (), minimum=0)

    def __call__(self, scene: Scene, solution: Solution) -> Float[Array, " residual"]:
        controller = controller_of(scene)
        demands = relative_demands(controller, scene.linkage, solution)
        efforts = jnp.clip(demands, -1, 1)
        rates = jnp.diff(efforts, axis=0) / jnp.diff(solution.ts)[:, None]
        parts = [tip_errors(scene, solution)]
        for price, values in ((self.effort, efforts), (self.effort_rate, rates)):
            # The root of a price has no derivative at zero.
            share = jnp.where(price > 0, price, 1) / values.shape[0]
            scaled = jnp.where(price > 0, jnp.sqrt(share), 0) * values
            parts.append(scaled.reshape(-1))
        return jnp.concatenate(parts)

    def check(self, scene: Scene) -> None:
        """Raises ValueError if efforts have a price but no limit."""
        limit = np.asarray(controller_of(scene).limit)
        possible = (np.isfinite(limit) & (limit > 0)).all()
        if self.effort + self.effort_rate > 0 and not possible:
            raise ValueError(
                "loss: expected finite limits of the controller, above 0, where effort "
                f"has a price, got {limit.tolist()}."
            )
