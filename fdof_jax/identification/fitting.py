"""Identification: parameters of a scene from recordings of its motion."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..checks import function, keywords_as, real_array
from ..search.bounded import Run, minimise
from ..search.lanes import Lanes
from ..search.methods import Evaluation
from ..search.simulated import check_scene, sum_of_squares
from ..simulation.scene import Scene, stacked
from ..simulation.sensitivities import sensitivities
from ..simulation.solution import Solution
from .recordings import link_ends, observations
from .result import FitResult, fit_result
from .unknowns import Shapes, Unknowns, named, unknowns_of

SceneAt = Callable[[dict[str, Array]], Scene]
Observe = Callable[[Scene, Solution], Array]

_TOLERANCE = 1e-7  # of the derivatives, and of the dense output
# A search stops when the loss falls by less than this part. One standard error of a
# parameter changes the loss by about one part in the number of readings, far more.
_ENOUGH = 1e-8
# Parts of the recording that are fitted in turn, each starting from the previous
# result. Over a short time a motion is nearly linear in its parameters; a search over
# all of the time from the start may end in a local minimum.
_SHARES = (0.25, 0.5, 0.75, 1.0)
_ENOUGH_EARLY = 1e-3  # only a start for the next part is needed


class _Problem(NamedTuple):
    """A recording, its scene and observation; `weight` is 0 where a sample is missing.

    The parameters, of the given shapes, are `scale` times the unknowns.
    """

    scene_at: SceneAt
    observe: Observe
    shapes: Shapes
    scale: Any
    ts: Any
    observed: Any
    weight: Any


def _lane(z: Array, problem: _Problem) -> Evaluation:
    """Evaluates a recording's weighted sum of squares and its derivatives in `z`."""
    weight = problem.weight

    def scene_at(z):
        return problem.scene_at(named(problem.shapes, problem.scale * z))

    def residuals(scene, solution):
        seen = jnp.asarray(problem.observe(scene, solution))
        if seen.shape != problem.observed.shape:
            raise ValueError(
                "observed: expected the shape of what `observe` returns, "
                f"{seen.shape}, got {problem.observed.shape}."
            )
        misfit = jnp.where(weight > 0, seen - problem.observed, 0)
        return (weight * misfit).reshape(-1)

    found = sensitivities(scene_at, residuals, z, problem.ts, _TOLERANCE)
    unweighted = found.residuals / jnp.where(weight > 0, weight, 1).reshape(-1)
    return sum_of_squares(found, squares=jnp.sum(unweighted**2))


def _check_scene_at(scene_at: SceneAt, parameters: dict[str, Array], ts: Array) -> None:
    try:
        scene = scene_at(parameters)
    except KeyError as error:
        raise ValueError(
            f"start: expected a value for {error}, which scene_at may use, got "
            f"{list(parameters)}."
        ) from error
    check_scene("scene_at(...)", scene, ts)


def _silent(found: Evaluation) -> np.ndarray:
    """Returns which unknowns have no effect (run, n)."""
    return np.diagonal(found.curvature, axis1=1, axis2=2) == 0


def _longer_and_longer(
    rows: list[list[_Problem]], unknowns: Unknowns, **keywords: Any
) -> list[Run]:
    """Searches over growing shares of the time; returns the runs over all of it."""
    keywords |= dict(method="levenberg-marquardt", describe=_squares_so_far)
    z, low, high = (
        np.broadcast_to(numbers / unknowns.scale, (len(rows), numbers.size))
        for numbers in (unknowns.start, unknowns.low, unknowns.high)
    )

    def until(share: float) -> Lanes:
        """The lanes with weights for readings up to this share of the time only."""

        def shortened(problem: _Problem) -> _Problem:
            ts, weight = np.asarray(problem.ts), problem.weight
            early = (ts - ts[0]) / (ts[-1] - ts[0]) <= share
            return problem._replace(weight=(weight.T * early).T)

        return Lanes(_lane, [[shortened(problem) for problem in row] for row in rows])

    for share, longer in zip(_SHARES, _SHARES[1:]):
        runs = minimise(until(share), z, low, high, enough=_ENOUGH_EARLY, **keywords)
        # Over a short time, noise may lead away from the parameters, or to where one of
        # them has no effect: to a cable that never becomes taut.
        better, every = until(longer), np.arange(len(rows))
        found = np.stack([run.z for run in runs])
        there, here = better(found, every), better(z, every)
        gain = (there.loss < here.loss) & ~(_silent(there) & ~_silent(here)).any(axis=1)
        z = np.where(gain[:, None], found, z)
    return minimise(until(1), z, low, high, enough=_ENOUGH, **keywords)


def _search(
    scenes_at: Sequence[Any],
    start: Any,
    ts: ArrayLike,
    observed: Any,
    together: bool,
    *,
    observe: Observe,
    noise: ArrayLike | None,
    bounds: Mapping[str, Any] | None,
    scale: Mapping[str, Any] | None,
    max_steps: int,
    report: Callable[[str], Any] | None,
) -> list[FitResult]:
    """Fits all recordings `together` in one result, or returns one result for each.

    The keywords are those of `fit`; `observed` has recordings as first axis.
    """
    unknowns = unknowns_of(start, bounds, scale)
    ts = real_array("ts", ts, (None,))
    if ts.size < 2 or not (np.diff(ts) > 0).all():
        raise ValueError(f"ts: expected two or more increasing times, got {ts}.")
    readings, weights = observations(observed, noise, ts)
    for scene_at in scenes_at:
        function("scene_at", scene_at)
    function("observe", observe)
    stacked(scenes_at, "scene_at")  # raises unless all are alike
    first = jax.tree.map(jnp.asarray, named(unknowns.shapes, unknowns.start))
    for scene_at in scenes_at:
        _check_scene_at(scene_at, first, ts)
    problems = [
        _Problem(scene_at, observe, unknowns.shapes, unknowns.scale, ts, *row)
        for scene_at, *row in zip(scenes_at, readings, weights)
    ]
    rows = [problems] if together else [[problem] for problem in problems]
    counts = [sum(int((p.weight > 0).sum()) for p in row) for row in rows]
    if min(counts) <= unknowns.start.size:
        raise ValueError(
            f"observed: expected more readings than the {unknowns.start.size} "
            f"unknowns, got {min(counts)}."
        )
    runs = _longer_and_longer(rows, unknowns, max_steps=max_steps, report=report)
    if any(run.failed for run in runs):
        raise ValueError(
            "start: expected parameters at which the scene can be simulated over ts, "
            f"got {start!r}."
        )
    return [
        fit_result(run, row[0].scene_at, unknowns, noise is not None, count)
        for run, row, count in zip(runs, rows, counts)
    ]


def _squares_so_far(runs: list[Run]) -> str:
    squares = sum(run.best.facts["squares"].sum() for run in runs)
    return f"sum of squares {squares:.6g}"


def fit(
    scene_at: SceneAt | Sequence[SceneAt],
    start: Mapping[str, ArrayLike],
    ts: ArrayLike,
    observed: ArrayLike,
    *,
    observe: Observe = link_ends,
    noise: ArrayLike | None = None,
    bounds: Mapping[str, Any] | None = None,
    scale: Mapping[str, Any] | None = None,
    max_steps: int = 50,
    report: Callable[[str], Any] | None = None,
) -> FitResult:
    """Fits parameters of a scene to recordings of its motion, by least squares.

    Parameters may be masses, inertias, offsets, damping, starting positions: anything
    in a scene. The fit uses the Levenberg-Marquardt method with exact derivatives. It
    fits the first quarter of the time, continues with the first half, and so on, up to
    all of it. A second call with other numbers compiles nothing, if `scene_at` and
    `observe` are the same functions or Equinox modules of the same structure.

    **Arguments:**

    - `scene_at`: returns the scene for a dict of named parameters (numbers or arrays);
      the scene's `t1` is ignored. A list of several, Equinox modules that differ in
      numbers, is fitted together, with one recording each.
    - `start`: first guess of each parameter, in its own SI unit.
    - `ts`: increasing times (time,), from the start of the motion [s].
    - `observed`: the recording, of the shape that `observe` returns; recordings of
      several scenes are stacked along a leading axis. NaN marks a missing sample.
    - `observe`: `(scene, solution) -> readings`, an array with time as first axis. By
      default `link_ends`, markers (time, 3, 2) at the ends of the moving links [m]; use
      `lambda scene, solution: solution.q` for joint encoders.
    - `noise`: standard deviation of a reading [its unit], one number or an array that
      broadcasts to a recording. If None, all readings have the same weight, and the
      noise is estimated from the residuals.
    - `bounds`: (least, greatest) of parameters by name.
    - `scale`: sizes of parameters by name; a step changes a parameter by at most two
      sizes. By default the magnitudes of the start, which then must not be 0.
    - `max_steps`: greatest number of evaluations after the first, of each search.
    - `report`: called with a line of progress after each step, for instance `print`.

    **Returns:** a `FitResult`, with standard errors and the combinations of parameters
    that the motion does not determine.

    **Raises:** ValueError for malformed arguments, and if the scene cannot be simulated
    from the start.
    """
    scenes_at: Any = scene_at
    recordings: Any = observed
    if not isinstance(scene_at, list | tuple):
        scenes_at, recordings = [scene_at], [observed]
    elif not scene_at or np.shape(observed)[:1] != (len(scene_at),):
        raise ValueError(
            "observed: expected a recording for each of the scenes (one at least), got "
            f"shape {np.shape(observed)} for {len(scene_at)}."
        )
    return _search(
        scenes_at, start, ts, recordings, True, observe=observe, noise=noise,
        bounds=bounds, scale=scale, max_steps=max_steps, report=report,
    )[0]  # fmt: skip


def fit_each(
    scene_at: SceneAt,
    start: Mapping[str, ArrayLike],
    ts: ArrayLike,
    observed: ArrayLike,
    **keywords: Any,
) -> list[FitResult]:
    """Fits each of several recordings, in one compiled program.

    **Arguments:** `observed`: with recordings as leading axis, for instance markers
    (recording, time, 3, 2) [m]; the others as in `fit`.

    **Returns:** a list of `FitResult`s.

    **Raises:** ValueError as `fit`; TypeError for unknown keywords.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig3()
    >>> def damped(p):
    ...     return fj.Scene(arm, start, (fj.JointDamper(p["damping"]),), 1.0)
    >>> ts = np.linspace(0, 1, 51)
    >>> dampers = fj.JointDamper(15.0), fj.JointDamper(25.0)
    >>> motions = [fj.simulate(arm, start, ts, (damper,)) for damper in dampers]
    >>> scene = damped({"damping": 1.0})
    >>> markers = np.stack([fj.identification.link_ends(scene, m) for m in motions])
    >>> found = fj.identification.fit_each(damped, {"damping": 20.0}, ts, markers)
    >>> [float(each.parameters["damping"]) for each in found]
    [15.0, 25.0]
    """
    recordings = np.shape(observed)[:1]
    if not recordings or recordings[0] == 0:
        raise ValueError(
            "observed: expected recordings along a leading axis, got shape "
            f"{np.shape(observed)}."
        )
    keywords = keywords_as(fit, keywords)
    return _search([scene_at] * recordings[0], start, ts, observed, False, **keywords)
