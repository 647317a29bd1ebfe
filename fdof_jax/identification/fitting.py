"""Identification of a scene's parameters from recordings of its motion."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks import refusal
from ..tuning.search import Evaluation, Lanes, Run, check_motion, minimise
from .problems import (
    Bounds,
    Observe,
    Problem,
    SceneAt,
    Unknowns,
    check_times,
    lane,
    link_ends,
    problems_of,
    unknowns_of,
)
from .result import FitResult, fit_result

Recordings = tuple[SceneAt | Sequence[SceneAt], ArrayLike]  # of scenes

# A search stops when the loss falls by less than this part. A change of a parameter by
# one standard error changes it by one part in the number of readings, which is more.
_ENOUGH = 1e-8
# Parts of the recording that are fitted in turn, each starting from the previous
# result. Over a short time a motion is nearly linear in its parameters; a search over
# all of the time from the start may end in a local minimum.
_SHARES = (0.25, 0.5, 0.75, 1.0)
_ENOUGH_EARLY = 1e-3  # only a start for the next part is needed


def _silent(found: Evaluation) -> np.ndarray:
    """Returns which unknowns have no effect (run, n)."""
    return np.diagonal(found.curvature, axis1=1, axis2=2) == 0


def _longer_and_longer(
    rows: list[list[Problem]], unknowns: Unknowns, **keywords: Any
) -> list[Run]:
    """Searches over growing shares of the time; returns the runs over all of it."""

    def squares_so_far(runs: list[Run]) -> str:
        squares = sum(run.best.facts["squares"].sum() for run in runs)
        return f"sum of squares {squares:.6g}"

    keywords |= dict(method="levenberg-marquardt", describe=squares_so_far)
    z, low, high = unknowns.box(len(rows))

    def lanes_until(share: float) -> Lanes:
        """The lanes with weights up to this share of the time only."""

        def shortened(problem: Problem) -> Problem:
            ts, weight = np.asarray(problem.ts), problem.weight
            early = (ts - ts[0]) / (ts[-1] - ts[0]) <= share
            return problem._replace(weight=(weight.T * early).T)

        return Lanes(lane, [[shortened(problem) for problem in row] for row in rows])

    *stages, whole = map(lanes_until, _SHARES)
    for stage, longer in zip(stages, [*stages[1:], whole]):
        runs = minimise(stage, z, low, high, enough=_ENOUGH_EARLY, **keywords)
        # Over a short time, noise may lead away from the parameters, or to where one of
        # them has no effect: to a cable that never becomes taut.
        every, found = np.arange(len(rows)), np.stack([run.z for run in runs])
        there, here = longer(found, every), longer(z, every)
        gain = (there.loss < here.loss) & ~(_silent(there) & ~_silent(here)).any(axis=1)
        z = np.where(gain[:, None], found, z)
    return minimise(whole, z, low, high, enough=_ENOUGH, **keywords)


def _search(
    together: bool, *, scene_at, start, ts, observed, observe, noise, validate, bounds,
    scale, **search: Any,
) -> list[FitResult]:  # fmt: skip
    """Fits all recordings `together` in one result, or each in its own."""
    unknowns = unknowns_of(start, bounds, scale)
    settings = unknowns, check_times(ts), observe, 1.0 if noise is None else noise
    problems = problems_of(("scene_at", "observed"), scene_at, observed, *settings)
    held_out: list[Problem] = []
    if validate is not None:
        if not isinstance(validate, tuple) or len(validate) != 2:
            expected = "(scene_at, observed), as for the fit itself"
            raise refusal("validate", expected, validate)
        held_out = problems_of(("validate[0]", "validate[1]"), *validate, *settings)
        wanted, shape = problems[0].observed.shape, held_out[0].observed.shape
        if shape != wanted or not all(p.weight.any() for p in held_out):
            raise ValueError(
                f"validate[1]: expected recordings like `observed`, of shape {wanted}, "
                f"with some readings each, got shape {shape}."
            )
    rows = [problems] if together else [[problem] for problem in problems]
    least = min(sum(int((p.weight > 0).sum()) for p in row) for row in rows)
    if least <= unknowns.start.size:
        raise ValueError(
            f"observed: expected more readings than the {unknowns.start.size} "
            f"unknowns, got {least}."
        )
    runs = _longer_and_longer(rows, unknowns, **search)
    failed = [row for run, row in zip(runs, rows) if run.failed]
    if failed:
        for problem in failed[0]:
            scene = problem.scene_at(unknowns.named(unknowns.start))
            check_motion("scene_at(...)", scene, problem.ts)
        expected = (
            "parameters at which the motion and its derivatives are finite (a norm of "
            "0 has none)"
        )
        raise refusal("start", expected, start)
    evaluated = [None] * len(runs)
    if held_out:
        lanes = Lanes(lane, [held_out], starts=len(runs))
        found = lanes(np.stack([run.z for run in runs]), np.arange(len(runs)))
        evaluated = [found.row(index) for index in range(len(runs))]
    return [
        fit_result(run, row, unknowns, noise is not None, other)
        for run, row, other in zip(runs, rows, evaluated)
    ]


def fit(
    scene_at: SceneAt | Sequence[SceneAt],
    start: Mapping[str, ArrayLike],
    ts: ArrayLike,
    observed: ArrayLike,
    *,
    observe: Observe = link_ends,
    noise: ArrayLike | None = None,
    validate: Recordings | None = None,
    bounds: Bounds | None = None,
    scale: Mapping[str, ArrayLike] | None = None,
    max_steps: int = 50,
    report: Callable[[str], object] | None = None,
) -> FitResult:
    """Fits parameters of a scene to recordings of its motion, by least squares.

    Parameters may be anything in a scene, such as masses, damping or starting
    positions. The Levenberg-Marquardt method fits the first quarter of the time, then
    half, three quarters and all of it. Later calls compile nothing if `scene_at` and
    `observe` are functions of equal code or Equinox modules of the same structure.

    **Arguments:**

    - `scene_at`: returns the scene for a dict of named parameters; its `t1` is ignored.
      To fit several scenes together, with a recording each, give a list of Equinox
      modules that differ only in numbers.
    - `start`: first guess of each parameter, a number or an array [its SI unit].
    - `ts`: increasing times (time,) [s]. The motion starts at `ts[0]`; if readings
      begin later, keep this time, with NaN readings.
    - `observed`: the recording, of the shape that `observe` returns; several are
      stacked along a leading axis. NaN marks a missing reading.
    - `observe`: `(scene, solution) -> readings`, (time, ...). By default `link_ends`
      [m]; for joint encoders use `lambda scene, solution: solution.q`.
    - `noise`: standard deviation of a reading [its unit], which must broadcast to a
      recording. By default all readings weigh the same, and the noise is estimated: for
      standard errors from the residuals, for the verdict from their changes between
      successive times.
    - `validate`: held-out (scene_at, observed) at the same times, best of motions
      unlike the fitted ones. The result compares their residuals with the noise.
    - `bounds`: (least, greatest) of parameters by name.
    - `scale`: sizes of parameters by name; a step changes a parameter by at most two
      sizes. By default the magnitudes of the start, which then must not be 0.
    - `max_steps`: greatest number of evaluations after the first, of each search.
    - `report`: called with a line of progress after each step, such as `print`.

    **Raises:** ValueError for malformed arguments, and if the scene cannot be simulated
    from the start.
    """
    return _search(
        True, scene_at=scene_at, start=start, ts=ts, observed=observed, observe=observe,
        noise=noise, validate=validate, bounds=bounds, scale=scale,
        max_steps=max_steps, report=report,
    )[0]  # fmt: skip


def fit_each(
    scene_at: SceneAt,
    start: Mapping[str, ArrayLike],
    ts: ArrayLike,
    observed: ArrayLike,
    **keywords: Any,
) -> list[FitResult]:
    """Fits each of several recordings on its own, in one compiled program.

    **Arguments:** as in `fit`, but `observed` has a leading axis of recordings, for
    instance (recording, time, link, 2) [m].

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
    try:
        shape = np.shape(observed)
    except ValueError:  # of rows of unlike lengths
        shape = ()
    if 0 in shape[:1] or not shape:
        raise refusal("observed", "recordings along a leading axis", observed)
    of_each = [scene_at] * shape[0]
    given = inspect.signature(fit).bind(of_each, start, ts, observed, **keywords)
    given.apply_defaults()
    return _search(False, **given.arguments)
