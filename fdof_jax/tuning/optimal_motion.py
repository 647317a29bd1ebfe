"""Open-loop efforts that track a task best: a bound for any controller."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..analysis.tracking import tip_deviation
from ..checks import instance, place_of, real_array, whole_number
from ..control.model_based import ComputedTorque
from ..control.pd import PDController
from ..forces.element import elements
from ..forces.joints import EffortHistory
from ..linkage.linkage import check_linkage
from ..references.reference import reference_of
from ..search.bounded import Run, minimise, reporting
from ..search.lanes import Lanes
from ..search.methods import Evaluation
from ..simulation.efforts import joint_efforts
from ..simulation.scene import Scene
from ..simulation.sensitivities import sensitivities
from ..simulation.simulate import check_elements, simulate
from ..simulation.solution import Solution
from .losses import controller_of

_SAMPLES = 501
# The tolerance of derivatives and motion. Their errors make the loss uneven: at 1e-5,
# searches from different guesses end at different places.
_TOLERANCE = 1e-8
_ENOUGH = 1e-7
# Converged: to first order, an effort changed by its limit changes the loss by less
# than this part.
_SMALL_GRADIENT = 1e-2
# The bandwidth of the computed torque that makes one of the first guesses [1/s]: its
# tracking error decays within half a second.
_BANDWIDTH = 10.0


class _Knots(EffortHistory):
    """An effort history at whose kinks steps end, as derivatives in efforts need it."""

    @property
    def jump_ts(self) -> Array:
        return self.ts


class OptimalMotion(eqx.Module):
    """The best open-loop motion found; prints itself in a few lines.

    - `scene`: the scene with an `EffortHistory` in place of its controller, up to the
      horizon.
    - `ts`, `efforts`: the knots (knot,) [s] and the efforts there (knot, 3)
      [N or N m].
    - `tip_error`: rms tip error over the horizon [m], without the price of effort.
    - `controller_error`: rms tip error of the scene's own controller [m].
    - `solution`: the motion, at 501 times.
    - `guess_errors`: rms tip error found from each first guess (guess,) [m]. If they
      differ, the objective has several minima, and the best counts.
    - `converged`: whether, to first order, no change of the efforts by their limits
      would decrease the objective by more than a hundredth.
    - `message`: why the best run stopped, in words.
    """

    scene: Scene
    ts: Float[np.ndarray, " knot"]
    efforts: Float[np.ndarray, "knot joint"]
    tip_error: float
    controller_error: float
    solution: Solution
    guess_errors: Float[np.ndarray, " guess"]
    converged: bool
    message: str

    def bound(self, t1: ArrayLike) -> float:
        """Lower bound of the rms tip error [m] from 0 to `t1`: see `optimal_efforts`.

        **Arguments:** `t1`: not before the horizon [s].

        **Raises:** ValueError for an earlier `t1`.
        """
        horizon = float(self.ts[-1])
        t1 = float(real_array("t1", t1, (), minimum=horizon))
        return self.tip_error * (horizon / t1) ** 0.5

    def __str__(self) -> str:
        found = ", ".join(f"{1e3 * error:.5g}" for error in self.guess_errors)
        return "\n".join(
            [
                f"rms tip error over {self.ts[-1]:g} s: {1e3 * self.tip_error:.5g} mm, "
                f"with {len(self.ts)} knots",
                f"of the controller: {1e3 * self.controller_error:.5g} mm",
                f"from each first guess: {found} mm",
                f"{'converged' if self.converged else 'not converged'}: {self.message}",
            ]
        )


def _roots_of_weights(ts: Array) -> Array:
    """Roots of the trapezium weights: scaled squares sum to their mean over time."""
    gaps = jnp.diff(ts)
    shares = jnp.concatenate([gaps[:1], gaps[1:] + gaps[:-1], gaps[-1:]]) / 2
    return jnp.sqrt(shares / (ts[-1] - ts[0]))


@eqx.filter_jit
def _deviations(scene: Scene, task: Any, solution: Solution) -> Array:
    """Tip errors at the output times, scaled so that their squares sum to the mean."""
    roots = _roots_of_weights(solution.ts)
    return (roots[:, None] * tip_deviation(scene.linkage, task, solution)).reshape(-1)


def _with(scene: Scene, replaced: type, element: Any) -> Scene:
    """The scene with `element` in place of the element of class `replaced`."""
    forces = (element if isinstance(f, replaced) else f for f in scene.forces)
    return scene._replace(forces=tuple(forces))


def _lane(z: Array, problem: tuple[Scene, Any, Array, Array, Array]) -> Evaluation:
    """Evaluates mean squared tip error plus price, in efforts over limits `z`.

    `problem`: the scene with `_Knots`, the task, the controller's limits, the price,
    and the times of the tip errors.
    """
    scene, task, limit, price, ts = problem
    (knots,) = (force.ts for force in scene.forces if isinstance(force, _Knots))

    def scene_at(z):
        return _with(scene, _Knots, _Knots(knots, limit[None] * z.reshape(-1, 3)))

    def rates(z):
        changes = jnp.diff(z.reshape(-1, 3), axis=0)
        gaps = jnp.diff(knots) * (knots[-1] - knots[0])
        return (changes / jnp.sqrt(gaps)[:, None]).reshape(-1)

    def residuals(trial, solution):
        return _deviations(trial, task, solution)

    errors, jacobian, _, solution = sensitivities(
        scene_at, residuals, z, ts, _TOLERANCE
    )
    bent = jax.jacfwd(rates)(z)
    evaluation: Any = Evaluation  # of JAX arrays, which become NumPy's
    return evaluation(
        jnp.sum(errors**2) + price * jnp.sum(rates(z) ** 2),
        2 * (errors @ jacobian + price * rates(z) @ bent),
        2 * (jacobian.T @ jacobian + price * bent.T @ bent),
        dict(tip_error=jnp.sqrt(jnp.sum(errors**2)), steps=solution.stats["num_steps"]),
    )


def _check(scene: Any, horizon: Any) -> float:
    """Checks scene and horizon, and returns the horizon as a number."""
    instance("scene", scene, Scene)
    check_linkage(scene.linkage)
    t1 = float(real_array("scene.t1", scene.t1, (), above=0))
    horizon = float(real_array("horizon", horizon, (), above=0))
    if horizon > t1:
        raise ValueError(
            f"horizon: expected at most the scene's t1, {t1:g} s, got {horizon:g} s."
        )
    elements("scene.forces", scene.forces)
    controller = controller_of(scene)
    limit = np.asarray(controller.limit)
    if not np.isfinite(limit).all():
        raise ValueError(
            "scene: expected finite limits of its controller, as unlimited efforts "
            f"have no best, got {limit.tolist()}."
        )
    if reference_of(controller.reference).tip is None:
        raise ValueError(
            "scene: expected its controller to track a task with a `tip`, got "
            f"{controller.reference!r}."
        )
    check_elements(scene.forces, scene.linkage, jnp.array([0.0, horizon]))
    return horizon


def optimal_efforts(
    scene: Scene,
    *,
    horizon: ArrayLike = 1.0,
    knots: int = 41,
    effort_rate: ArrayLike = 1e-9,
    max_steps: int = 400,
    report: Callable[[str], Any] | None = None,
) -> OptimalMotion:
    """Computes the efforts within a controller's limits that track its path best.

    The open-loop efforts replace the controller. They minimise the mean squared tip
    error over [0, horizon] from the scene's start, among efforts that are linear
    between knots. The result is a benchmark for any controller with the same limits.

    Over a longer run [0, t1], any controller's mean squared tip error is at least the
    minimum times horizon / t1, reached if the tip is exactly on its path after the
    horizon (`OptimalMotion.bound`). This bound is rigorous only if the minimum is
    global. That is not proved: it is the best found from two first guesses, the efforts
    of the scene's own controller and those of computed torque. Efforts that jump
    between the knots may do slightly better; double the knots to see by how much.

    A short horizon suffices, because most of the error arises on the way to the path.
    If the arm tumbles by itself, a longer horizon makes the efforts harder to find.

    **Arguments:**

    - `scene`: must hold exactly one `PDController`, with finite limits and a reference
      with a `tip`. Other elements remain.
    - `horizon`: at most the scene's `t1` [s].
    - `knots`: number of knots, equally spaced from 0 to the horizon, two or more.
    - `effort_rate`: price of mean((d(tau / limit)/dt)^2), summed over the joints
      [m^2 s^2]. With three joints for two coordinates of the tip many efforts are
      equally good: the price picks smooth ones. For arms of other sizes, scale it with
      the square of the tip error.
    - `max_steps`: greatest number of evaluations of a run after the first.
    - `report`: called with a line of progress after each step, for instance `print`.

    **Returns:** an `OptimalMotion`.

    **Raises:** ValueError for malformed arguments; RuntimeError if the motion fails
    with the efforts of every first guess.

    >>> import fdof_jax as fj
    >>> scene = fj.scenes.fig7()
    >>> best = fj.tuning.optimal_efforts(scene, horizon=0.3, knots=7, max_steps=20)
    >>> best.controller_error, best.tip_error  # [m]
    (0.119, 0.08)
    """
    horizon = _check(scene, horizon)
    knots = whole_number("knots", knots, 2)
    price = real_array("effort_rate", effort_rate, (), minimum=0)
    told = reporting(report, _errors_so_far)
    controller = controller_of(scene)
    task, limit = controller.reference, np.asarray(controller.limit)
    ts, times = np.linspace(0, horizon, _SAMPLES), np.linspace(0, horizon, knots)

    def moved(scene: Scene) -> Solution:
        return simulate(scene.linkage, scene.state0, ts, scene.forces, throw=False)

    def error_of(scene: Scene, solution: Solution) -> float:
        return float(np.linalg.norm(_deviations(scene, task, solution)))

    kp, kd = jnp.full(3, _BANDWIDTH**2), jnp.full(3, 2 * _BANDWIDTH)
    known = ComputedTorque(kp, kd, jnp.asarray(limit), task, None)
    guides = [scene, _with(scene, PDController, known)]
    solutions = [moved(guide) for guide in guides]
    guesses = [
        _efforts_at(times, guide, solution)
        for guide, solution in zip(guides, solutions)
    ]
    # Efforts without a limit above zero are zero, whatever the unknowns.
    bound = np.tile(np.where(limit > 0, 1.0, 0.0), knots)
    start = np.stack([(tau / np.where(limit > 0, limit, 1)).ravel() for tau in guesses])
    start = np.clip(np.nan_to_num(start), -bound, bound)
    free = _with(scene, PDController, _Knots(jnp.asarray(times), jnp.zeros((knots, 3))))
    lanes = Lanes(_lane, [[(free, task, limit, price, ts)]], starts=len(start))
    bounds = np.broadcast_to(bound, start.shape)
    runs = minimise(
        lanes, start, -bounds, bounds, method="levenberg-marquardt",
        max_steps=max_steps, enough=_ENOUGH, report=told,
    )  # fmt: skip
    runs = [run for run in runs if np.isfinite(run.best.loss)]
    if not runs:
        raise RuntimeError(
            "optimal_efforts: the simulation fails with the efforts of every first "
            "guess; use a shorter horizon."
        )
    run = min(runs, key=lambda run: run.best.loss)
    efforts = limit * run.best.z.reshape(-1, 3)
    found = _with(scene, PDController, EffortHistory(times, efforts))
    found = found._replace(t1=horizon)
    solution = moved(found)
    return OptimalMotion(
        scene=found,
        ts=times,
        efforts=efforts,
        tip_error=error_of(found, solution),
        controller_error=error_of(scene, solutions[0]),
        solution=solution,
        guess_errors=np.array([_tip_error(run) for run in runs]),
        converged=run.best.gradient_norm <= _SMALL_GRADIENT * run.best.loss,
        message=str(run.reason),
    )


def _efforts_at(times: np.ndarray, scene: Scene, solution: Solution) -> np.ndarray:
    """Efforts of a scene's controller along its motion, (time, 3)."""
    controller = controller_of(scene)
    efforts = joint_efforts(scene.linkage, scene.forces, solution).elements
    mine = np.asarray(efforts[place_of(controller, scene.forces)])
    return np.stack([np.interp(times, solution.ts, column) for column in mine.T], 1)


def _tip_error(run: Run) -> float:
    return float(run.best.facts["tip_error"][0])


def _errors_so_far(runs: list[Run]) -> str:
    errors = ", ".join(f"{1e3 * _tip_error(run):.5g}" for run in runs)
    return f"rms tip error from each first guess: {errors} mm"
