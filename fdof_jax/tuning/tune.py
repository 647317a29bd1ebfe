"""Tuning of PD gains by gradients through the simulation."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, overload

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..checks import (
    callable_tuple,
    instance,
    is_traced,
    keywords_as,
    one_of,
    real_array,
    whole_number,
)
from ..linkage.linkage import check_linkage, joint_names, real_state
from ..search.bounded import METHODS, Evaluation, Row, Run, minimise, reporting
from ..search.lanes import Lanes
from ..simulation.scene import Scene, stacked, unstacked
from ..simulation.sensitivities import TOLERANCE, sensitivities
from ..simulation.simulate import check_elements
from ..simulation.solution import Solution
from .losses import Tracking, controller_of, relative_demands, tip_errors
from .result import TradeOff, TuneResult, result_of

Loss = Callable[[Scene, Solution], Array]

_SAMPLES = 1001
_ENOUGH = 1e-4  # half of it in the rms
# The worst of an ensemble is smoothed to a power mean of this order: of n members it is
# at most a factor of n^(1/32) below the worst.
_WORST = 32


def with_gains(scene: Scene, gains: Array) -> Scene:
    """The scene with other kp and kd, the rows of `gains`."""
    controller = controller_of(scene)
    index = [force is controller for force in scene.forces].index(True)
    controller = eqx.tree_at(lambda c: (c.kp, c.kd), controller, (gains[0], gains[1]))
    forces = (*scene.forces[:index], controller, *scene.forces[index + 1 :])
    return scene._replace(forces=forces)


def evaluate_gains(z: Array, problem: tuple[Scene, Loss, Array]) -> Evaluation:
    """One member's loss and its derivatives in the log-gains `z`.

    `problem`: the scene, the loss, and which gains are tuned.
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
        # The square of a scalar loss's root is the loss; at 0 it has no derivative.
        return jnp.where(value == 0, 0, jnp.sqrt(jnp.where(value == 0, 1, value)))[None]

    ts = jnp.linspace(0, scene.t1, _SAMPLES)
    value, jacobian, trial, solution = sensitivities(scene_at, residuals, z, ts)
    demands = jnp.abs(relative_demands(trial, solution))
    # An actuator without effort makes none, whatever is asked of it.
    limited = jnp.where(controller_of(trial).limit > 0, 1, 0)[None]
    square_error = jnp.full((), jnp.nan)
    if hasattr(controller_of(trial).reference, "tip"):
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
    """Raise ValueError unless this scene can be tuned by this loss."""
    instance(name, scene, Scene)
    if is_traced(scene):
        raise ValueError(
            f"{name}: expected known values, got {scene!r}: gains are tuned outside of "
            "JAX's transformations."
        )
    check_linkage(scene.linkage)
    real_state(f"{name}.state0", scene.state0)
    t1 = real_array(f"{name}.t1", scene.t1, (), above=0)
    callable_tuple(f"{name}.forces", scene.forces)
    controller = controller_of(scene)
    check_elements(scene.forces, scene.linkage, jnp.stack([jnp.zeros_like(t1), t1]))
    if isinstance(loss, Tracking):
        loss.check(scene)
    if isinstance(loss, Tracking) or loss is tip_errors:
        if not hasattr(controller.reference, "tip"):
            raise ValueError(
                "loss: expected one of your own, because the reference has no `tip` "
                f"for the tip error, got {controller.reference!r}."
            )


def _check_alike(name: str, member: Scene, scene: Scene) -> None:
    """Raise ValueError unless the gains of both are of one meaning."""
    kinds = [
        (joint_names(s.linkage), type(controller_of(s)).__name__)
        for s in (member, scene)
    ]
    if kinds[0] != kinds[1]:
        raise ValueError(
            f"{name}: expected joints and a controller like the scene's, {kinds[1]}, "
            f"got {kinds[0]}."
        )


def _bounds(scene: Scene, factor: Any, bounds: Any) -> tuple[np.ndarray, ...]:
    """Of kp and kd: the start, the least, the greatest; (2, 3) each."""
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
    # Gains of zero stay zero.
    return start, np.where(start > 0, lower, 0), np.where(start > 0, upper, 0)


def _started(box, starts: int, draw: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Starts and bounds in the log-gains, (start, 6) each."""
    real = (box[0] > 0).ravel()
    here, least, most = (np.log(np.where(real, b.ravel(), 1)) for b in box)
    others = draw.uniform(least, most, (starts - 1, 6))
    same = (np.broadcast_to(a, (starts, 6)) for a in (least, most))
    return np.concatenate([here[None], others]), *same


def _search(
    scenes: Sequence[Scene],
    losses: Sequence[Any],
    *,
    factor: ArrayLike | None,
    bounds: tuple[ArrayLike, ArrayLike] | None,
    ensemble: Scene | None,
    over: str,
    method: str,
    starts: int,
    seed: int,
    max_steps: int,
    report: Callable[[str], Any] | None,
) -> list[TuneResult]:
    """One result per scene and loss; the keywords are those of `tune`."""
    one_of("method", method, tuple(METHODS))
    one_of("over", over, ("mean", "worst"))
    if over == "worst" and ensemble is None:
        raise ValueError("over: expected an ensemble to take the worst of, got none.")
    starts = whole_number("starts", starts, 1)
    draw = np.random.default_rng(whole_number("seed", seed, 0))
    told = reporting(report, _best_so_far)
    for scene, loss in zip(scenes, losses):
        if not callable(loss) or isinstance(loss, type):
            raise ValueError(f"loss: expected a callable, got {loss!r}.")
        check_tuned("scene", scene, loss)
    boxes = [_bounds(scene, factor, bounds) for scene in scenes]
    if ensemble is None:
        members = [[scene] for scene in scenes]
    else:
        members = [unstacked("ensemble", ensemble)] * len(losses)
        for i, member in enumerate(members[0]):
            check_tuned(f"ensemble[{i}]", member, losses[0])
            _check_alike(f"ensemble[{i}]", member, scenes[0])
    problems = [
        [(member, loss, lower > 0) for member in row]
        for row, loss, (_, lower, _) in zip(members, losses, boxes)
    ]
    lanes = Lanes(evaluate_gains, problems, starts, {"mean": 1, "worst": _WORST}[over])
    columns = zip(*(_started(box, starts, draw) for box in boxes))
    z, low, high = map(np.concatenate, columns)
    runs = minimise(
        lanes, z, low, high, method=method, max_steps=max_steps,
        enough=_ENOUGH, report=told,
    )  # fmt: skip
    settings = dict(
        method=method,
        over=over if ensemble is not None else "one scene",
        solver="Tsit5",
        tolerance=TOLERANCE,
        samples=_SAMPLES,
        dtype=str(jnp.result_type(float)),
    )
    results = []
    for i, (scene, (_, lower, upper)) in enumerate(zip(scenes, boxes)):
        mine = runs[i * starts : (i + 1) * starts]
        if all(run.failed for run in mine):
            raise _failure(members[i], mine[0].rows[0], ensemble is not None)
        results.append(result_of(scene, mine, lower, upper, settings, with_gains))
    return results


def _failure(members: list[Scene], first: Row, ensemble: bool) -> ValueError:
    """What is wrong if no start can be evaluated, judged by the first of them."""
    failing = np.flatnonzero(~first.facts["simulated"])
    if failing.size == 0:
        return ValueError(
            "loss: expected finite numbers, not negative if only one, with finite "
            "derivatives, got a loss that is not so at the scene's own gains."
        )
    index = int(failing[0])
    name = f"ensemble[{index}]" if ensemble else "scene"
    return ValueError(
        f"{name}: expected one that can be simulated up to t1 = "
        f"{float(members[index].t1):g} s with the scene's own gains, got one that "
        "fails before."
    )


def _best_so_far(runs: list[Run]) -> str:
    best = min(runs, key=lambda run: (run.failed, run.best.loss)).best
    error = 1e3 * np.sqrt(np.mean(best.facts["square_error"]))
    what = f"loss {best.loss:.6g}"
    if np.isfinite(error):
        what += f", rms tip error {error:.5g} mm"
    return f"{what}, projected gradient {best.gradient_norm:.2g}"


def tune(
    scene: Scene,
    *,
    factor: ArrayLike | None = None,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    loss: Loss = tip_errors,
    ensemble: Scene | None = None,
    over: str = "mean",
    method: str = "levenberg-marquardt",
    starts: int = 1,
    seed: int = 0,
    max_steps: int = 50,
    report: Callable[[str], Any] | None = None,
) -> TuneResult:
    """Gains of a scene's PD controller that make its loss small, within bounds.

    The unknowns are the logarithms of kp and kd; gains of zero stay zero. Derivatives
    are integrated beside the motion at a tolerance of 1e-5: good to a millionth of
    their norm, to some ten thousandths where actuators are at their limits for long,
    which `gradient_report` measures. A second call with other numbers compiles nothing,
    nor does one with another method; one with another function for a loss does.

    **Arguments:**

    - `scene`: holds exactly one `PDController`.
    - `factor`: the gains stay within this factor of their start, above 1; by default 4.
    - `bounds`: instead of a factor, the least and the greatest kp and kd: two arrays
      (2, 3), first row kp, second kd [N/m or N m/rad, N s/m or N m s/rad].
    - `loss`: `(scene, solution) -> residuals`, an array whose sum of squares is made
      small, or a scalar that is made small itself and is never negative (for which
      Levenberg-Marquardt has little to go by). By default `tip_errors`: the mean
      squared tip error over [0, t1]. `Tracking` puts a price on effort.
    - `ensemble`: scenes like `scene` stacked along a leading axis (`stacked`,
      `perturbed`). The gains, which are the same for all and start from those of
      `scene`, are judged by them instead.
    - `over`: "mean", the mean loss of the ensemble, or "worst", its worst as a power
      mean of order 32.
    - `method`: "levenberg-marquardt", "l-bfgs" or "adam" (the latter two by optax).
    - `starts`: how many runs: one from the scene's gains, the others from random ones
      within the bounds. The best counts.
    - `seed`: of the random starts.
    - `max_steps`: the greatest number of evaluations of a run after the first.
    - `report`: is given a line of progress after each step, `print` for instance.

    Not for use within JAX's transformations, as steps are decided by NumPy.

    **Returns:** a `TuneResult`, which says why it stopped.

    **Raises:** ValueError for malformed arguments, and if the scene cannot be simulated
    from its start.
    """
    return _search(
        [scene], [loss], factor=factor, bounds=bounds, ensemble=ensemble, over=over,
        method=method, starts=starts, seed=seed, max_steps=max_steps, report=report,
    )[0]  # fmt: skip


@overload
def tune_each(
    scenes: Mapping[str, Scene], *, loss: Loss = ..., **keywords: Any
) -> dict[str, TuneResult]: ...
@overload
def tune_each(
    scenes: Sequence[Scene], *, loss: Loss = ..., **keywords: Any
) -> list[TuneResult]: ...
def tune_each(scenes: Any, *, loss: Loss = tip_errors, **keywords: Any) -> Any:
    """`tune` for several scenes of one structure, in one compiled program.

    The topologies may differ.

    **Arguments:** `scenes`: a list or a dict by name, as `circle_scenes` gives; the
    others as in `tune`, but without an `ensemble`.

    **Returns:** a list of `TuneResult`s, or a dict by the same names.

    **Raises:** ValueError as `tune`, and for scenes of different structure; TypeError
    for unknown keywords.

    >>> import fdof_jax as fj
    >>> scenes = fj.circle_scenes()
    >>> pair = {name: scenes[name]._replace(t1=1.0) for name in ("PPR", "RRR")}
    >>> results = fj.tune_each(pair, max_steps=2)
    >>> {name: result.tip_error for name, result in results.items()}  # [m]
    {'PPR': 0.0077, 'RRR': 0.0293}
    """
    if isinstance(scenes, Mapping):
        results = tune_each(list(scenes.values()), loss=loss, **keywords)
        return dict(zip(scenes, results))
    keywords = keywords_as(tune, keywords, without=("loss", "ensemble", "over"))
    stacked(scenes)  # refuses what is not alike
    keywords |= dict(ensemble=None, over="mean")
    return _search(scenes, [loss] * len(scenes), **keywords)


def trade_off(scene: Scene, prices: ArrayLike, **keywords: Any) -> TradeOff:
    """The least tip errors for their efforts: `tune` for each price, in one program.

    **Arguments:** `scene`; `prices` of effort (price,), see `Tracking` [m^2]; the
    others as in `tune`, but for `loss`.

    **Returns:** a `TradeOff`, in the order of the prices.

    **Raises:** ValueError as `tune`; TypeError for unknown keywords.
    """
    keywords = keywords_as(tune, keywords, without=("loss",))
    prices = np.asarray(real_array("prices", prices, (None,), minimum=0))
    if prices.size == 0:
        raise ValueError("prices: expected at least one, got none.")
    losses = [Tracking(effort=price) for price in prices]
    results = _search([scene] * len(prices), losses, **keywords)
    error, effort = np.array([(r.tip_error, r.effort) for r in results]).T
    return TradeOff(prices, error, effort, results)
