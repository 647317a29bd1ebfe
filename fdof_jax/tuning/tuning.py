"""Tuning of gains within bounds."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from .. import Scene
from ..checks import one_of, refusal, whole_number
from ..linkage import joint_names
from .losses import (
    SAMPLES,
    TOLERANCE,
    Loss,
    bounds_of,
    checked,
    controller_of,
    evaluate_gains,
    gains_of,
    tip_errors,
    unusable_loss,
    with_gains,
)
from .result import TuneResult, result_of
from .search import METHODS, Lanes, Row, Run, best_of, check_motion, minimise
from .stacks import unstacked

_ENOUGH = 1e-4  # relative decrease of the loss; half of it in the rms error
# The worst of an ensemble is smoothed to a power mean of this order. With n members it
# is at most a factor of n^(1/32) below the worst.
_ORDERS = {"mean": 1, "worst": 32}


def _members(ensemble: Scene, scene: Scene, loss: Loss) -> list[Scene]:
    """Checks `ensemble` of `tune`; its members get the scene's gains."""
    alike = lambda s: (joint_names(s.linkage), type(controller_of(s)).__name__)
    members = []
    for i, each in enumerate(unstacked("ensemble", ensemble)):
        member = checked(f"ensemble[{i}]", each, loss)
        if alike(member) != alike(scene):
            expected = f"joints and a controller like the scene's, {alike(scene)}"
            raise refusal(f"ensemble[{i}]", expected, alike(member))
        members.append(with_gains(member, gains_of(scene)))
    return members


def _failure(members: list[Scene], first: Row, ensemble: bool) -> ValueError:
    """The error if no start can be evaluated, judged by the first."""
    failing = np.flatnonzero(~first.facts["simulated"])
    if failing.size == 0:
        return unusable_loss()
    index = failing[0]
    name = f"ensemble[{index}]" if ensemble else "scene"
    end = float(members[index].t1)
    check_motion(name, members[index], [0.0, end])
    return ValueError(
        f"{name}: expected a motion with finite derivatives up to t1 = {end:g} s at "
        "its own gains, got some that are not finite."
    )


def _best_so_far(runs: list[Run]) -> str:
    best = best_of(runs).best
    error = 1e3 * np.sqrt(np.mean(best.facts["square_error"]))
    tip = f", rms tip error {error:.5g} mm" if np.isfinite(error) else ""
    return f"loss {best.loss:.6g}{tip}, projected gradient {best.gradient_norm:.2g}"


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
    report: Callable[[str], object] | None = None,
) -> TuneResult:
    """Minimises a scene's loss over the gains of its PD controller, within bounds.

    The unknowns are the logarithms of kp and kd; gains of zero stay zero. Derivatives
    have a relative error of about 1e-6, or some 1e-4 if actuators are at their limits
    for long. `tune` cannot be used within JAX's transformations.

    **Arguments:**

    - `scene`: with exactly one `PDController`, `GravityFeedforward` or
      `ComputedTorque`.
    - `factor`: the gains stay within this factor of their start; above 1, by default 4.
    - `bounds`: instead of a factor, least and greatest gains: two arrays (2, n) with
      the rows kp and kd [N/m or N m/rad, N s/m or N m s/rad].
    - `loss`: `(scene, solution) -> residuals`, whose sum of squares is minimised. By
      default the mean squared tip error at 1001 equally spaced times in [0, t1]. A
      scalar, which must not be negative, is minimised itself; choose "l-bfgs" for it.
    - `ensemble`: scenes like `scene`, from `stacked`. All get the same gains, which
      start from those of `scene`.
    - `over`: "mean" or "worst" loss of the ensemble; the worst is a power mean of order
      32.
    - `method`: "levenberg-marquardt" or "l-bfgs".
    - `starts`: number of runs, of which the best counts. All but the first start from
      random gains within the bounds.
    - `seed`: of the random starts.
    - `max_steps`: greatest number of evaluations per run after the first.
    - `report`: called with a line of progress after each step, such as `print`.

    **Raises:** ValueError for malformed arguments, and if the scene cannot be
    simulated.
    """
    one_of("method", method, tuple(METHODS))
    one_of("over", over, tuple(_ORDERS))
    if over == "worst" and ensemble is None:
        raise ValueError("over: expected an ensemble to take the worst of, got none.")
    starts = whole_number("starts", starts, 1, np.iinfo(np.int32).max)
    draw = np.random.default_rng(whole_number("seed", seed, 0))
    sized = checked("scene", scene, loss)
    box = bounds_of(scene, factor, bounds)
    members = [sized] if ensemble is None else _members(ensemble, scene, loss)
    problem = [(member, loss) for member in members]
    z, low, high = np.repeat([box.logs()], starts, axis=0).swapaxes(0, 1)
    # The first run starts from the scene's gains, the others at random.
    z[1:] = draw.uniform(low[1:], high[1:])
    runs = minimise(
        Lanes(evaluate_gains, [problem], starts, _ORDERS[over]), z, low, high,
        method=method, max_steps=max_steps, enough=_ENOUGH, report=report,
        describe=_best_so_far,
    )  # fmt: skip
    if all(run.failed for run in runs):
        raise _failure(members, runs[0].rows[0], ensemble is not None)
    settings = dict(
        method=method,
        over=over if ensemble is not None else "one scene",
        solver="Dopri8",
        tolerance=TOLERANCE,
        samples=SAMPLES,
        dtype=str(jnp.result_type(float)),
    )
    return result_of(scene, runs, box, settings)
