"""Design of experiments: the motion to record next."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from .. import Scene, Solution, simulate
from ..checks import check_scene, function, instance, real_array, refusal, shown
from ..data import Report
from ..simulation import sensitivities
from ..tuning.search import Evaluation, Lanes, Run, check_motion, minimise
from .problems import (
    Bounds,
    Named,
    Observe,
    SceneAt,
    Unknowns,
    check_times,
    link_ends,
    unknowns_of,
)
from .result import FitResult

# The largest standard error is smoothed as the norm of this order.
_ORDER = 8
# A parameter is known at least to this many sizes, so that an experiment that says
# nothing of it can be improved.
_IGNORANCE = 1e3
# Weight of the barrier before the limits: with a tenth of it, searches end earlier.
_BARRIER = 0.1
_ENOUGH = 1e-5  # a search stops when the loss falls by less than this part


class NextMotion(Report):
    """The motion to record next; prints itself.

    - `motion`: its numbers by name, for `experiment`.
    - `standard_errors`: those expected if all recordings are fitted together, by name
      [unit of each parameter].
    - `improvement`: largest relative standard error so far over the expected one [1].
    - `message`: why the search stopped.
    """

    motion: Named
    standard_errors: Named
    improvement: float
    message: str

    def _rows(self) -> list[list[str]]:
        errors = {f"error of {k}": v for k, v in self.standard_errors.items()}
        rows = []
        for name, value in (self.motion | errors).items():
            for row in np.atleast_2d(value):
                rows.append([name, *(f"{x:.4g}" for x in row.ravel())])
                name = ""
        return [["", "numbers"], *rows]

    def _remarks(self) -> list[str]:
        return [
            f"expected standard errors, the largest {self.improvement:.3g} times less",
            self.message,
        ]


class _Design(NamedTuple):
    """An experiment, and the `information` (n, n) so far on its relative parameters."""

    experiment: Callable[..., SceneAt]
    observe: Observe
    within: Callable[[Scene, Solution], Array] | None
    motion: Unknowns
    parameters: Unknowns
    information: Array | np.ndarray
    ts: Array
    noise: Array | np.ndarray


def _lane(z: Array, design: _Design) -> Evaluation:
    """Evaluates the largest relative standard error, smoothed, with its barrier."""

    def loss(z):
        scene_at = design.experiment(**design.motion.at(z))
        parameters = design.parameters
        values, sizes = parameters.start, parameters.scale

        def changed(change: Array) -> Scene:
            return scene_at(parameters.named(values + sizes * change))

        def readings(scene, solution):
            seen = jnp.asarray(design.observe(scene, solution))
            return (seen / jnp.broadcast_to(design.noise, seen.shape)).reshape(-1)

        found = sensitivities(changed, readings, jnp.zeros_like(values), design.ts)
        information = design.information + found.jacobian.T @ found.jacobian
        errors = jnp.sqrt(jnp.diag(jnp.linalg.inv(information)))
        top = jax.lax.stop_gradient(errors.max())
        largest = top * jnp.sum((errors / top) ** _ORDER) ** (1 / _ORDER)
        if design.within is not None:
            room = 1 - jnp.asarray(design.within(found.scene, found.solution)) ** 2
            room = jnp.where(room > 0, room, jnp.nan)  # rejects motions beyond limits
            largest = largest * jnp.exp(-_BARRIER * jnp.mean(jnp.log(room)))
        return largest, (largest, errors)

    gradient, (value, errors) = jax.jacfwd(loss, has_aux=True)(z)
    no_curvature = jnp.zeros((z.size, z.size))  # L-BFGS estimates it
    return Evaluation(value, gradient, no_curvature, {"errors": errors})


def next_motion(
    experiment: Callable[..., SceneAt],
    found: FitResult,
    start: Mapping[str, ArrayLike],
    ts: ArrayLike,
    *,
    noise: ArrayLike,
    bounds: Bounds,
    within: Callable[[Scene, Solution], Array] | None = None,
    observe: Observe = link_ends,
    scale: Mapping[str, ArrayLike] | None = None,
    max_steps: int = 1000,
    report: Callable[[str], object] | None = None,
) -> NextMotion:
    """Finds the motion that most reduces the largest relative standard error of a fit.

    A few named numbers describe a motion, such as efforts at knots. Standard errors are
    those expected of a fit of all recordings, at the parameters found. The search finds
    the best motion near `start`; other starts may lead to better ones.

    **Arguments:**

    - `experiment`: takes the motion's numbers by name and returns the `scene_at` of
      `fit`; for instance a class of Equinox modules.
    - `found`: the `FitResult` of the earlier recordings. Parameters determined only in
      combination count as unknown.
    - `start`: first guess of the motion's numbers, strictly within all limits.
    - `ts`: increasing times of the new recording (time,) [s].
    - `noise`: standard deviation of its readings, as in `fit` [their unit].
    - `bounds`: finite (least, greatest) of the motion's numbers by name.
    - `within`: `(scene, solution) -> array` of numbers to keep between -1 and 1, such
      as speeds over their limits.
    - `observe`, `report`: as in `fit`.
    - `scale`: sizes of parameters by name, to which standard errors are relative; by
      default the magnitudes found.
    - `max_steps`: greatest number of evaluations after the first.

    **Raises:** ValueError for malformed arguments, and if `start` exceeds the limits or
    cannot be simulated.
    """
    if not callable(experiment):  # which may be a class
        raise refusal("experiment", "a callable", experiment)
    instance("found", found, FitResult)
    instance("start", start, Mapping)
    ts = check_times(ts)
    noise = np.asarray(real_array("noise", noise, None, above=0))
    if within is not None:
        function("within", within)
    function("observe", observe)
    motion = unknowns_of(start, bounds, dict.fromkeys(start, 1.0))
    motion = motion._replace(scale=(motion.high - motion.low) / 2)
    if not (np.isfinite(motion.scale) & (motion.scale > 0)).all():
        expected = f"finite ones for all of {shown(list(start))}"
        raise refusal("bounds", expected, bounds)
    parameters = unknowns_of(found.parameters, None, scale)
    sizes = parameters.scale
    first = motion.named(jnp.asarray(motion.start))
    scene = experiment(**first)(jax.tree.map(jnp.asarray, found.parameters))
    check_scene("experiment(...)(...)", scene)
    information = _information(found.covariance / np.outer(sizes, sizes))
    design = _Design(
        experiment, observe, within, motion, parameters, information, ts, noise
    )

    def largest_so_far(runs: list[Run]) -> str:
        errors = runs[0].best.facts["errors"]
        return f"largest standard error {100 * errors.max():.3g} %"

    (run,) = minimise(
        Lanes(_lane, [[design]]), *motion.box(1), method="l-bfgs", max_steps=max_steps,
        enough=_ENOUGH, report=report, describe=largest_so_far,
    )  # fmt: skip
    if run.failed:
        check_motion("experiment(...)(...)", scene, ts)
        if within is not None:
            shares = np.asarray(within(scene, simulate(scene, ts)))
            entry = np.unravel_index(np.argmax(np.abs(shares)), shares.shape)
            if not abs(shares[entry]) < 1:
                raise ValueError(
                    "start: expected a motion that stays strictly between -1 and 1 in "
                    f"`within`, got {shares[entry]:.3g} in entry "
                    f"{[int(i) for i in entry]}."
                )
        raise ValueError(
            "start: expected a motion with finite readings and derivatives, got some "
            "that are not finite."
        )
    errors = run.best.facts["errors"][0]
    before = np.sqrt(np.diag(found.covariance)) / sizes
    return NextMotion(
        motion=motion.named(motion.numbers(run.z)),
        standard_errors=parameters.named(errors * sizes),
        improvement=float(before.max() / errors.max()),
        message=run.reason,
    )


def _information(covariance: np.ndarray) -> np.ndarray:
    """Inverse of a covariance, whose infinite rows say nothing."""
    finite = np.isfinite(np.diag(covariance))
    information = np.eye(len(covariance)) / _IGNORANCE**2
    part = np.ix_(finite, finite)
    information[part] += np.linalg.inv(covariance[part])
    return information
