"""Identification: parameters of a scene from recordings of its motion."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import keywords_as, real_array
from ..forces.element import elements
from ..linkage.coordinates import real_state
from ..linkage.linkage import check_linkage
from ..mechanics.kinematics import joint_positions, tip_position
from ..search.bounded import Run, minimise, reporting
from ..search.lanes import Lanes
from ..search.methods import Evaluation
from ..simulation.scene import Scene, stacked
from ..simulation.sensitivities import sensitivities
from ..simulation.simulate import check_elements
from ..simulation.solution import Solution
from .result import FitResult, fit_result
from .unknowns import unknowns_of

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


def link_ends(scene: Scene, solution: Solution) -> Float[Array, "time link 2"]:
    """Positions of three markers: the joints at the ends of links 2 and 3, and the tip.

    **Arguments:** `scene`; `solution`: its motion.

    **Returns:** points (x, y) from the ground pivot [m].

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101))
    >>> fj.identification.link_ends(fj.scenes.fig5(), motion)[0].tolist()
    [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]
    """

    def ends(q):
        tip = tip_position(scene.linkage, q)
        return jnp.concatenate([joint_positions(scene.linkage, q)[1:], tip[None]])

    return jax.vmap(ends)(solution.q)


class _Problem(NamedTuple):
    """A recording, its scene and observation; `weight` is 0 where a sample is missing.

    The parameters are `scale` times the unknowns.
    """

    scene_at: SceneAt
    observe: Observe
    names: tuple[str, ...]
    scale: tuple[Any, ...]
    ts: Any
    observed: Any
    weight: Any


def _lane(z: Array, problem: _Problem) -> Evaluation:
    """Evaluates a recording's weighted sum of squares and its derivatives in `z`."""

    def scene_at(z):
        splits = np.cumsum([scale.size for scale in problem.scale])[:-1]
        parts = [
            scale * part.reshape(scale.shape)
            for scale, part in zip(problem.scale, jnp.split(z, splits))
        ]
        return problem.scene_at(dict(zip(problem.names, parts)))

    def residuals(scene, solution):
        seen = jnp.asarray(problem.observe(scene, solution))
        if seen.shape != problem.observed.shape:
            raise ValueError(
                "observed: expected the shape of what `observe` returns, "
                f"{seen.shape}, got {problem.observed.shape}."
            )
        misfit = jnp.where(problem.weight > 0, seen - problem.observed, 0)
        return (problem.weight * misfit).reshape(-1)

    value, jacobian, _, solution = sensitivities(
        scene_at, residuals, z, problem.ts, _TOLERANCE
    )
    raw = value / jnp.where(problem.weight > 0, problem.weight, 1).reshape(-1)
    facts: Any = dict(squares=jnp.sum(raw**2), steps=solution.stats["num_steps"])
    loss: Any = jnp.sum(value**2)
    gradient: Any = 2 * jacobian.T @ value
    curvature: Any = 2 * jacobian.T @ jacobian
    return Evaluation(loss, gradient, curvature, facts)


def _observations(observed: Any, noise: Any) -> tuple[np.ndarray, np.ndarray]:
    """Readings (recording, time, ...), 0 where missing, and their weights."""
    try:
        readings = np.asarray(observed, dtype=jnp.result_type(float))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"observed: expected an array of real numbers, got {observed!r}."
        ) from error
    if np.isinf(readings).any():
        raise ValueError("observed: expected finite readings (or NaN), got infinity.")
    there = ~np.isnan(readings)
    spread = np.ones(()) if noise is None else noise
    spread = np.asarray(real_array("noise", spread, np.shape(spread), above=0))
    try:
        weights = np.broadcast_to(1 / spread, readings.shape[1:])
    except ValueError:
        raise ValueError(
            "noise: expected one number, or an array that broadcasts to a recording, "
            f"{readings.shape[1:]}, got shape {spread.shape}."
        ) from None
    return np.where(there, readings, 0), np.where(there, weights, 0)


def _check_scene(scene: Any, ts: Array) -> None:
    if not isinstance(scene, Scene):
        raise ValueError(f"scene_at: expected it to return a Scene, got {scene!r}.")
    check_linkage(scene.linkage)
    real_state("scene_at(...).state0", scene.state0, scene.linkage)
    elements("scene_at(...).forces", scene.forces)
    check_elements(scene.forces, scene.linkage, ts)


def _called(scene_at: SceneAt, parameters: dict[str, Array]) -> Any:
    try:
        return scene_at(parameters)
    except KeyError as error:
        raise ValueError(
            f"start: expected a value for {error}, which scene_at may use, got "
            f"{list(parameters)}."
        ) from error


def _longer_and_longer(
    until: Callable[[float], Lanes],
    z: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    **keywords: Any,
) -> list[Run]:
    """Searches over growing shares of the time; returns the runs over all of it."""
    keywords = dict(method="levenberg-marquardt") | keywords
    for share, longer in zip(_SHARES, _SHARES[1:]):
        runs = minimise(until(share), z, low, high, enough=_ENOUGH_EARLY, **keywords)
        # Over a short time, noise may lead away from the parameters.
        better = until(longer)
        found, every = np.stack([run.z for run in runs]), np.arange(len(z))
        gain = better(found, every).loss < better(z, every).loss
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
    told = reporting(report, _squares_so_far)
    ts = real_array("ts", ts, (None,))
    if ts.size < 2 or not (np.diff(ts) > 0).all():
        raise ValueError(f"ts: expected two or more increasing times, got {ts}.")
    readings, weights = _observations(observed, noise)
    if readings.shape[1:2] != ts.shape:
        raise ValueError(
            f"observed: expected a row for each of the {ts.size} times, got shape "
            f"{readings.shape[1:]}."
        )
    for name, value in (*(("scene_at", s) for s in scenes_at), ("observe", observe)):
        if not callable(value):
            raise ValueError(f"{name}: expected a callable, got {value!r}.")
    stacked(scenes_at, "scene_at")  # raises unless all are alike
    first = dict(zip(unknowns.names, map(jnp.asarray, unknowns.start)))
    for scene_at in scenes_at:
        _check_scene(_called(scene_at, first), ts)
    problems = [
        _Problem(scene_at, observe, unknowns.names, unknowns.scale, ts, *row)
        for scene_at, *row in zip(scenes_at, readings, weights)
    ]
    rows = [problems] if together else [[problem] for problem in problems]
    passed = np.asarray((ts - ts[0]) / (ts[-1] - ts[0]))
    passed = passed.reshape(-1, *[1] * (readings.ndim - 2))

    def until(share: float) -> Lanes:
        """The lanes with weights for readings up to this share of the time only."""
        early = passed <= share
        return Lanes(
            _lane, [[p._replace(weight=p.weight * early) for p in row] for row in rows]
        )

    counts = [sum(int((p.weight > 0).sum()) for p in row) for row in rows]
    if min(counts) <= unknowns.flat_start.size:
        raise ValueError(
            f"observed: expected more readings than the {unknowns.flat_start.size} "
            f"unknowns, got {min(counts)}."
        )
    box = unknowns.flat_start, unknowns.flat_low, unknowns.flat_high
    z, low, high = (
        np.broadcast_to(a / unknowns.flat_scale, (len(rows), a.size)) for a in box
    )
    runs = _longer_and_longer(until, z, low, high, max_steps=max_steps, report=told)
    if any(not np.isfinite(run.best.loss) for run in runs):
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
