"""Losses of a scene's motion, and their derivatives in the gains."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .. import Element, PDController, Scene, Solution, Values, field, tip_position
from ..checks import check_known, check_scene, function, real_array, refusal
from ..forces import Part, elements_on
from ..linkage import Linkage
from ..references import Reference, reference_of
from ..simulation import Sensitivities, sensitivities
from .search import Evaluation, check_solution, sum_of_squares

SAMPLES = 1001
# Of steps. Fig 7's mean squared error of the tip is then right to 1e-7 of itself, and
# its gradient in six gains too.
TOLERANCE = 1e-5
Loss = Callable[[Scene, Solution], Array]


def controller_of(scene: Scene) -> PDController:
    """A scene's PD controller; raises ValueError unless there is exactly one."""
    found = [force for force in scene.forces if isinstance(force, PDController)]
    if len(found) != 1:
        kinds = ", ".join(type(force).__name__ for force in scene.forces)
        raise ValueError(
            "scene: expected exactly one PDController among its forces (not one within "
            f"a drive or a PIDController), got {len(found)} among ({kinds})."
        )
    return found[0]


def with_controller(scene: Scene, element: Element) -> Scene:
    controller = controller_of(scene)
    forces = (element if force is controller else force for force in scene.forces)
    return scene._replace(forces=tuple(forces))


def tracked_task(scene: Scene, name: str = "scene") -> Any:
    """The task of a scene's controller; raises ValueError if it has no `tip`."""
    task = controller_of(scene).reference
    if reference_of(task).tip is None:
        expected = (
            "its controller to track a task with a `tip`, for the tip error "
            "(fdof_jax.tuning.joint_errors is a loss for others)"
        )
        raise refusal(name, expected, task)
    return task


def gains_of(scene: Scene) -> Array:
    """kp and kd of a scene's controller (2, n), 0 at fixed pairs."""
    controller = controller_of(scene)
    gains = controller.kp, controller.kd
    return jnp.stack([jnp.where(scene.linkage.fixed, 0, row) for row in gains])


def with_gains(scene: Scene, gains: Array) -> Scene:
    """The scene with `gains`, rows kp and kd, in its controller."""
    controller = controller_of(scene)
    changed = eqx.tree_at(lambda c: (c.kp, c.kd), controller, (gains[0], gains[1]))
    return with_controller(scene, changed)


def tip_errors(scene: Scene, solution: Solution) -> Float[Array, " residual"]:
    """Computes the tip error over time; its squares sum to the mean squared error.

    **Arguments:** `scene`, whose PD controller must track a task with a `tip`.

    **Returns:** x and y components [m], over the root of the number of times.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> scene = fj.scenes.fig7()
    >>> motion = fj.simulate(scene, np.linspace(0, 1, 101))
    >>> errors = fj.tuning.tip_errors(scene, motion)
    >>> float((errors**2).sum() ** 0.5)  # rms over the first second [m]
    0.351
    """
    check_solution(scene, solution)
    deviation = tip_deviation(scene.linkage, tracked_task(scene), solution)
    return deviation.reshape(-1) / solution.ts.size**0.5


@eqx.filter_jit
def tip_deviation(
    linkage: Linkage, task: Reference, solution: Solution
) -> Float[Array, "time 2"]:
    """Vectors from the commanded to the actual tip along a motion [m]."""
    actual = jax.vmap(tip_position, in_axes=(None, 0))(linkage, solution.q)
    return actual - jax.vmap(task.tip)(solution.ts)


def joint_errors(scene: Scene, solution: Solution) -> Float[Array, " residual"]:
    """Computes joint errors over time; their squares sum to the mean squared error.

    Use it as a loss if the controller's reference has no `tip`. Errors of slides [m]
    and angles [rad] add up as they are. Joints with kp and kd 0 do not count.

    **Arguments:** `scene`, with exactly one `PDController`.

    **Returns:** q - q_ref [m or rad], over the root of the number of times.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> scene = fj.scenes.fig7()
    >>> motion = fj.simulate(scene, np.linspace(0, 1, 101))
    >>> errors = fj.tuning.joint_errors(scene, motion)
    >>> float((errors**2).sum() ** 0.5)  # rms over the first second
    0.097
    """
    check_solution(scene, solution)
    controller = controller_of(scene)
    commanded = lambda t: controller.schedule(t, scene.linkage)[0]
    errors = solution.q - jax.vmap(commanded)(solution.ts)
    driven = (gains_of(scene) != 0).any(axis=0)  # fixed pairs are not
    errors = jnp.where(driven, errors, 0)
    return errors.reshape(-1) / solution.ts.size**0.5


def demands(
    controller: PDController, linkage: Linkage, solution: Solution
) -> Float[Array, "time joint"]:
    """Computes a controller's demands along a motion, 0 at fixed pairs [N or N m]."""
    along = jax.vmap(controller.demand, in_axes=(0, 0, 0, None))
    found = along(solution.ts, solution.q, solution.qd, linkage)
    return jnp.where(linkage.fixed, 0, found)


@eqx.filter_jit
def relative_demands(
    controller: PDController, linkage: Linkage, solution: Solution
) -> Float[Array, "time joint"]:
    """The controller's demands over its limits; 0 at fixed pairs and infinite limits.

    A demand over a limit of 0 is an infinity of its sign.
    """
    demanded = demands(controller, linkage, solution)
    limit = jnp.broadcast_to(controller.limit, demanded.shape)
    beyond = jnp.where(demanded == 0, 0, jnp.sign(demanded) * jnp.inf)
    return jnp.where(limit > 0, demanded / jnp.where(limit > 0, limit, 1), beyond)


def _demands_and_efforts(scene: Scene, solution: Solution) -> tuple[Array, Array]:
    """The controller's demands and efforts over its limits, (time, joint) each."""
    controller = controller_of(scene)
    shares = relative_demands(controller, scene.linkage, solution)
    # An actuator with a limit of 0 makes no effort, whatever its demand.
    most = jnp.broadcast_to(jnp.where(controller.limit > 0, 1, 0), shares.shape)
    return shares, jnp.clip(shares, -most, most)


class Tracking(Part):
    """Mean squared tip error plus prices of effort: a loss for `tune`.

    It adds effort * mean(u^2) and effort_rate * mean((du/dt)^2) with u = tau / limit,
    summed over the joints. Rates are differences between output times.

    **Arguments:**

    - `effort`: price of full effort of one joint all the time [m^2].
    - `effort_rate`: price of a change by the full effort per second [m^2 s^2].

    **Raises:** ValueError for malformed or negative prices.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> scene = fj.scenes.fig7()
    >>> motion = fj.simulate(scene, np.linspace(0, 1, 101))
    >>> residuals = fj.tuning.Tracking(effort=0.1)(scene, motion)
    >>> float((residuals**2).sum())  # [m^2]
    0.15
    """

    effort: Values = field((), unit="m^2", minimum=0, default=0.0)
    effort_rate: Values = field((), unit="m^2 s^2", minimum=0, default=0.0)

    def __call__(self, scene: Scene, solution: Solution) -> Float[Array, " residual"]:
        _, efforts = _demands_and_efforts(scene, solution)
        rates = jnp.diff(efforts, axis=0) / jnp.diff(solution.ts)[:, None]
        parts = [tip_errors(scene, solution)]
        for price, values in ((self.effort, efforts), (self.effort_rate, rates)):
            # The root of a price has no derivative at zero.
            share = jnp.where(price > 0, price, 1) / values.shape[0]
            scaled = jnp.where(price > 0, jnp.sqrt(share), 0) * values
            parts.append(scaled.reshape(-1))
        return jnp.concatenate(parts)


class GainBox(NamedTuple):
    """kp and kd at the start, and their bounds: (2, n) each."""

    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def free(self) -> int:
        return int(np.sum(self.lower < self.upper))

    def at_bound(self, gains: np.ndarray) -> np.ndarray:
        """Returns which free gains a bound holds (2, n)."""
        held = (gains <= self.lower) | (gains >= self.upper)
        return held & (self.lower < self.upper)

    def logs(self) -> tuple[np.ndarray, ...]:
        """Returns logarithms of start and bounds over the start (2n,); 0 for zeros."""
        of_start = lambda gains: np.where(self.start > 0, gains / self.start, 1)
        with np.errstate(invalid="ignore"):  # 0 / 0
            return tuple(np.log(of_start(gains)).ravel() for gains in self)

    def gains(self, z: np.ndarray) -> np.ndarray:
        """Returns the gains (..., 2, n) for log-factors z (..., 2n)."""
        gains = self.start * np.exp(z).reshape(*z.shape[:-1], *self.start.shape)
        # exp(log(bound)) is rounded.
        hair = 100 * np.finfo(jnp.result_type(float)).eps
        for bound in (self.lower, self.upper):
            gains = np.where(np.abs(gains - bound) <= hair * bound, bound, gains)
        return np.clip(gains, self.lower, self.upper)


def gain_jacobian(
    z: Array, scene: Scene, loss: Loss, tolerance: float = TOLERANCE
) -> Sensitivities:
    """Residuals of a loss and their derivatives in the log-factors `z` of the gains."""
    gains = gains_of(scene)
    scene_at = lambda z: with_gains(scene, gains * jnp.exp(z).reshape(gains.shape))
    residuals = lambda scene, solution: residuals_of(loss, scene, solution)
    ts = jnp.linspace(0, scene.t1, SAMPLES)
    return sensitivities(scene_at, residuals, z, ts, tolerance)


def residuals_of(loss: Loss, scene: Scene, solution: Solution) -> Array:
    """Returns a loss as residuals (m,), whose squares are summed."""
    value = loss(scene, solution)
    size = np.shape(value) if eqx.is_array_like(value) else ()
    value = real_array("loss(scene, solution)", value, size)
    if value.ndim:
        return value.reshape(-1)
    # A scalar loss enters as its square root, whose derivative at 0 does not exist.
    return jnp.where(value == 0, 0, jnp.sqrt(jnp.where(value == 0, 1, value)))[None]


def unusable_loss() -> ValueError:
    """The error for a loss that is not finite at the start."""
    return ValueError(
        "loss: expected finite residuals, or one number that is not negative, with "
        "finite derivatives, got others at the scene's own gains."
    )


def evaluate_gains(z: Array, problem: tuple[Scene, Loss]) -> Evaluation:
    """Evaluates a scene's loss and its derivatives in the log-factors `z`."""
    found = gain_jacobian(z, *problem)
    scene, solution = found.scene, found.solution
    demands, efforts = _demands_and_efforts(scene, solution)
    square_error = jnp.full((), jnp.nan)
    if reference_of(controller_of(scene).reference).tip is not None:
        square_error = jnp.sum(tip_errors(scene, solution) ** 2)
    return sum_of_squares(
        found,
        saturated=jnp.mean(jnp.abs(demands) > 1, axis=0),
        effort=jnp.sqrt(jnp.mean(efforts**2, axis=0)),
        square_error=square_error,
        simulated=jnp.isfinite(solution.q[-1]).all(),
    )


def checked(name: str, scene: Scene, loss: Loss) -> Scene:
    """Checks a scene to tune; returns it with its forces' numbers for each joint."""
    check_scene(name, scene)
    function("loss", loss)
    check_known(name, scene)
    real_array(f"{name}.t1", scene.t1, (), above=0)
    controller = controller_of(scene)
    if isinstance(loss, Tracking) or loss is tip_errors:
        tracked_task(scene, name)
    if isinstance(loss, Tracking) and loss.effort + loss.effort_rate > 0:
        limit = np.asarray(controller.limit)
        if not (np.isfinite(limit) & (limit > 0)).all():
            raise ValueError(
                "loss: expected finite limits of the controller, above 0, where effort "
                f"has a price, got {limit.tolist()}."
            )
    return scene._replace(forces=elements_on(scene.linkage, scene.forces))


def bounds_of(
    scene: Scene, factor: ArrayLike | None, bounds: tuple[ArrayLike, ArrayLike] | None
) -> GainBox:
    """Checks `factor` and `bounds` of `tune`; gains of 0 stay 0."""
    start = np.asarray(gains_of(scene))
    if bounds is None:
        given = real_array("factor", 4.0 if factor is None else factor, (), above=1)
        return GainBox(start, start / float(given), start * float(given))
    if factor is not None:
        raise refusal("factor", "none beside bounds", factor)
    if not isinstance(bounds, tuple | list | np.ndarray) or len(bounds) != 2:
        raise refusal("bounds", "(lower, upper)", bounds)
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
    return GainBox(start, lower, np.where(start > 0, upper, 0))
