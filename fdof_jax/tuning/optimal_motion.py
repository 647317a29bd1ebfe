"""Open-loop efforts that track a task best: a bound for any controller."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..analysis.measures import tip_deviation
from ..base.checks import place_of, real_array, whole_number
from ..base.report import Report
from ..control.pd import ComputedTorque
from ..forces.joints import EffortHistory
from ..linkage.linkage import without_fixed
from ..references.task import TipReference
from ..search import (
    Evaluation,
    Lanes,
    Run,
    best_of,
    check_motion,
    minimise,
    sum_of_squares,
)
from ..simulation.efforts import joint_efforts
from ..simulation.jacobian import jacobian_of
from ..simulation.scene import Scene
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from .losses import check_tuned, controller_of, tracked_task, with_controller

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
            f"{'' if self.converged else 'not '}converged: {self.message}",
        ]


@eqx.filter_jit
def _deviations(scene: Scene, task: TipReference, solution: Solution) -> Array:
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
    task, place = tracked_task(scene), place_of(controller_of(scene), scene.forces)
    limit = without_fixed(scene.linkage, controller_of(scene).limit)[None]

    def scene_at(z):
        efforts = EffortHistory(knots, limit * z.reshape(knots.size, -1))
        return with_controller(scene, efforts)

    def residuals(trial, solution):
        errors = _deviations(trial, task, solution)
        efforts = trial.forces[place].tau / jnp.where(limit > 0, limit, 1)
        gaps = jnp.diff(knots)[:, None] * (knots[-1] - knots[0])
        changes = jnp.sqrt(price / gaps) * jnp.diff(efforts, axis=0)
        return jnp.concatenate([errors, changes.reshape(-1)])

    found = jacobian_of(scene_at, residuals, z, ts, _TOLERANCE)
    errors = found.residuals[: 2 * ts.size]
    return sum_of_squares(found, tip_error=jnp.linalg.norm(errors))


def optimal_efforts(
    scene: Scene,
    *,
    horizon: ArrayLike = 1.0,
    knots: int = 41,
    effort_rate: ArrayLike = 1e-9,
    max_steps: int = 400,
    report: Callable[[str], object] | None = None,
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
    task, t1 = tracked_task(scene), float(scene.t1)
    limit = np.asarray(without_fixed(scene.linkage, controller_of(scene).limit))
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

    def error_of(scene: Scene, solution: Solution) -> float:
        return float(np.linalg.norm(_deviations(scene, task, solution)))

    torque = ComputedTorque(_BANDWIDTH**2, 2 * _BANDWIDTH, limit, task)
    guides = [scene, with_controller(scene, torque)]
    motions = [simulate(guide, ts, throw=False) for guide in guides]
    place = place_of(controller_of(scene), scene.forces)
    own = [joint_efforts(*pair).elements[place] for pair in zip(guides, motions)]
    at_knots = lambda values: np.interp(times, ts, values)
    efforts = np.apply_along_axis(at_knots, 1, np.stack(own))  # (guide, knot, n)
    # Efforts without a limit above zero are zero, whatever the unknowns.
    most = np.broadcast_to(np.where(limit > 0, 1.0, 0.0), efforts.shape)
    start = np.clip(np.nan_to_num(efforts / np.where(limit > 0, limit, 1)), -most, most)
    start, most = start.reshape(len(guides), -1), most.reshape(len(guides), -1)
    runs = minimise(
        Lanes(_lane, [[(scene, times, price, ts)]], starts=len(start)),
        start, -most, most, method="levenberg-marquardt", max_steps=max_steps,
        enough=_ENOUGH, report=report, describe=_errors_so_far,
    )  # fmt: skip
    runs = [run for run in runs if not run.failed]
    if not runs:
        check_motion("scene", scene, ts)
        raise RuntimeError(
            "optimal_efforts: the simulation fails with the efforts of every first "
            "guess; use a shorter horizon."
        )
    run = best_of(runs)
    efforts = limit * run.z.reshape(knots, -1)
    found = with_controller(scene, EffortHistory(times, efforts))._replace(t1=end)
    solution = simulate(found, ts, throw=False)
    return OptimalMotion(
        scene=found,
        ts=times,
        efforts=efforts,
        tip_error=error_of(found, solution),
        controller_error=error_of(scene, motions[0]),
        solution=solution,
        guess_errors=np.array([run.best.facts["tip_error"][0] for run in runs]),
        converged=run.best.gradient_norm <= _SMALL_GRADIENT * run.best.loss,
        message=run.reason,
    )


def _errors_so_far(runs: list[Run]) -> str:
    errors = (1e3 * run.best.facts["tip_error"][0] for run in runs)
    words = ", ".join(f"{error:.5g}" for error in errors)
    return f"rms tip error from each first guess: {words} mm"
