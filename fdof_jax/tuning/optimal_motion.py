"""Open-loop efforts that track a task best: a bound for any controller."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..analysis.tracking import tip_deviation
from ..base.checks import place_of, real_array, whole_number
from ..base.report import Report
from ..control.model_based import ComputedTorque
from ..forces.joints import EffortHistory
from ..linkage.linkage import joints_of, without_fixed
from ..search.bounded import Run, best_of, minimise
from ..search.lanes import Lanes
from ..search.methods import Evaluation
from ..search.simulated import sum_of_squares
from ..simulation.efforts import joint_efforts
from ..simulation.scene import Scene
from ..simulation.sensitivities import sensitivities
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from .gains import check_tuned
from .losses import controller_of, with_controller

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


class OptimalMotion(Report):
    """The best open-loop motion found; prints itself in a few lines.

    - `scene`: the scene with an `EffortHistory` in place of its controller, up to the
      horizon.
    - `ts`, `efforts`: the knots (knot,) [s] and the efforts there (knot, n)
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

        **Raises:** ValueError for an earlier `t1`; RuntimeError if the search has not
        converged, because better efforts may then exist.
        """
        if not self.converged:
            raise RuntimeError(
                f"bound: expected a search that has converged, got {self.message!r}; "
                "use more max_steps or a shorter horizon."
            )
        horizon = float(self.ts[-1])
        t1 = float(real_array("t1", t1, (), minimum=horizon))
        return self.tip_error * (horizon / t1) ** 0.5

    def _remarks(self) -> list[str]:
        errors = ", ".join(f"{1e3 * error:.5g}" for error in self.guess_errors)
        return [
            f"rms tip error over {self.ts[-1]:g} s: {1e3 * self.tip_error:.5g} mm, "
            f"with {len(self.ts)} knots",
            f"of the controller: {1e3 * self.controller_error:.5g} mm",
            f"from each first guess: {errors} mm",
            f"{'converged' if self.converged else 'not converged'}: {self.message}",
        ]


@eqx.filter_jit
def _deviations(scene: Scene, task: Any, solution: Solution) -> Array:
    """Tip errors whose squares sum to their mean, by the trapezium rule."""
    gaps = jnp.diff(solution.ts)
    shares = jnp.concatenate([gaps[:1], gaps[1:] + gaps[:-1], gaps[-1:]]) / 2
    roots = jnp.sqrt(shares / jnp.sum(gaps))[:, None]
    return (roots * tip_deviation(scene.linkage, task, solution)).reshape(-1)


def _lane(z: Array, problem: tuple[Scene, Array, Array, Array]) -> Evaluation:
    """Evaluates mean squared tip error plus price, in efforts over limits `z`.

    `problem`: the scene, the knots, the price, and the times of the tip errors.
    """
    scene, knots, price, ts = problem
    controller = controller_of(scene)
    limit = jnp.broadcast_to(controller.limit, (1, joints_of(scene.linkage)))
    limit = without_fixed(scene.linkage, limit)

    def scene_at(z):
        return with_controller(
            scene, EffortHistory(knots, limit * z.reshape(knots.size, -1))
        )

    def residuals(trial, solution):
        errors = _deviations(trial, controller.reference, solution)
        (efforts,) = (
            force.tau for force in trial.forces if isinstance(force, EffortHistory)
        )
        changes = jnp.diff(efforts / jnp.where(limit > 0, limit, 1), axis=0)
        gaps = jnp.diff(knots)[:, None] * (knots[-1] - knots[0])
        return jnp.concatenate([errors, (jnp.sqrt(price / gaps) * changes).reshape(-1)])

    found = sensitivities(scene_at, residuals, z, ts, _TOLERANCE)
    errors = found.residuals[: 2 * ts.size]
    return sum_of_squares(found, tip_error=jnp.linalg.norm(errors))


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
    >>> scene = fj.scenes.two_link_circle()
    >>> best = fj.tuning.optimal_efforts(scene, horizon=0.5, knots=26)
    >>> best.controller_error, best.tip_error  # [m]
    (0.0501, 0.0222)
    """
    check_tuned("scene", scene)
    controller, t1 = controller_of(scene), float(scene.t1)
    task = controller.reference
    limit = np.broadcast_to(controller.limit, joints_of(scene.linkage))
    limit = np.asarray(without_fixed(scene.linkage, limit))
    if not np.isfinite(limit).all():
        raise ValueError(
            "scene: expected finite limits of its controller, as unlimited efforts "
            f"have no best, got {limit.tolist()}."
        )
    end = float(real_array("horizon", horizon, (), above=0))
    if end > t1:
        raise ValueError(
            f"horizon: expected at most the scene's t1, {t1:g} s, got {end:g} s."
        )
    knots = whole_number("knots", knots, 2)
    price = real_array("effort_rate", effort_rate, (), minimum=0)
    ts, times = np.linspace(0, end, _SAMPLES), np.linspace(0, end, knots)

    def moved(scene: Scene) -> Solution:
        return simulate(scene.linkage, scene.state0, ts, scene.forces, throw=False)

    def error_of(scene: Scene, solution: Solution) -> float:
        return float(np.linalg.norm(_deviations(scene, task, solution)))

    known = ComputedTorque(_BANDWIDTH**2, 2 * _BANDWIDTH, limit, task)
    guides = [scene, with_controller(scene, known)]
    solutions = [moved(guide) for guide in guides]
    # Efforts without a limit above zero are zero, whatever the unknowns.
    bound = np.tile(np.where(limit > 0, 1.0, 0.0), knots)
    start = np.stack(
        [
            (_efforts_at(times, *motion) / np.where(limit > 0, limit, 1)).ravel()
            for motion in zip(guides, solutions)
        ]
    )
    start = np.clip(np.nan_to_num(start), -bound, bound)
    lanes = Lanes(_lane, [[(scene, times, price, ts)]], starts=len(start))
    high = np.broadcast_to(bound, start.shape)
    runs = minimise(
        lanes, start, -high, high, method="levenberg-marquardt", max_steps=max_steps,
        enough=_ENOUGH, report=report, describe=_errors_so_far,
    )  # fmt: skip
    runs = [run for run in runs if not run.failed]
    if not runs:
        raise RuntimeError(
            "optimal_efforts: the simulation fails with the efforts of every first "
            "guess; use a shorter horizon."
        )
    run = best_of(runs)
    efforts = limit * run.z.reshape(knots, -1)
    found = with_controller(scene, EffortHistory(times, efforts))._replace(t1=end)
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
        message=run.reason,
    )


def _efforts_at(times: np.ndarray, scene: Scene, solution: Solution) -> np.ndarray:
    """Efforts of a scene's controller along its motion, (time, n)."""
    controller = controller_of(scene)
    efforts = joint_efforts(scene.linkage, scene.forces, solution).elements
    mine = np.asarray(efforts[place_of(controller, scene.forces)])
    return np.stack([np.interp(times, solution.ts, column) for column in mine.T], 1)


def _tip_error(run: Run) -> float:
    return float(run.best.facts["tip_error"][0])


def _errors_so_far(runs: list[Run]) -> str:
    errors = ", ".join(f"{1e3 * _tip_error(run):.5g}" for run in runs)
    return f"rms tip error from each first guess: {errors} mm"
