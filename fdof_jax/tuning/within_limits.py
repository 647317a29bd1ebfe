"""Tuning of gains within limits, by SciPy's sequential quadratic programming."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from ..base.checks import function, instance, whole_number
from ..base.report import Report
from ..linkage.fields import check_joints, sized
from ..linkage.linkage import joints_of
from ..search.lanes import Lanes
from ..search.methods import Evaluation
from ..search.simulated import sum_of_squares
from ..simulation.scene import Scene, with_full_size
from .gains import bounds_of, check_tuned, gain_sensitivities, residuals_of, with_gains
from .limits import Limits, controller_and_others, excess, measured
from .losses import Loss, gains_of, tip_errors
from .result import gain_rows, gain_table
from .tuning import unusable_loss

# The search aims this far within the limits, so that motions sampled more finely are
# within them too.
_WITHIN = 5e-4
# Price of the greatest excess, as a share of the loss at the start. The search exceeds
# no limit that it can meet, as long as the multipliers of all limits sum to less.
_PRICE = 100.0
_ENOUGH = 1e-6  # relative decrease of the loss at which the search ends
# The unknowns are scaled to equal curvatures of the loss, at least this share of it.
_FLAT = 1e-2
_FAILED = 1e6  # loss and excess where the simulation fails


def _lane(z: Array, problem: tuple[Scene, Loss, Array, Limits, bool]) -> Evaluation:
    """Evaluates a loss and the excess over limits in the log-gains `z` (2n,)."""
    scene, loss, tuned, limits, with_margins = problem

    def beyond(scene, solution):
        return excess(limits, scene, solution, with_margins)

    def residuals(scene, solution):
        own = residuals_of(loss, scene, solution)
        return jnp.concatenate([beyond(scene, solution), own])

    found = gain_sensitivities(z, scene, residuals, tuned)
    count = jax.eval_shape(beyond, found.scene, found.solution).size
    return sum_of_squares(
        found._replace(
            residuals=found.residuals[count:], jacobian=found.jacobian[count:]
        ),
        excess=found.residuals[:count],
        slopes=found.jacobian[:count],
    )


def _search(
    lanes: Lanes,
    first: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    max_steps: int,
    report: Callable[[str], Any] | None,
) -> tuple[np.ndarray, float, str]:
    """Returns the best log-gains (2n,), their loss, and why the search stopped.

    Its unknowns are the scaled log-gains between their bounds, and the greatest excess
    over the limits. As this has a price, limits that cannot be met are exceeded least.
    """
    free = low < high
    points: list[tuple[np.ndarray, Evaluation]] = []

    def evaluated(z: np.ndarray) -> Evaluation:
        if not points or (points[-1][0] != z).any():
            points.append((z, lanes(z[None], np.zeros(1, int)).row(0)))
            if report is not None:
                here = points[-1][1]
                worst = max(here.facts["excess"].max(), 0.0)
                report(f"{len(points):4d}  loss {here.loss:.6g}, excess {worst:.3g}")
        return points[-1][1]

    start = evaluated(first)
    if np.isnan(start.facts["excess"]).any():
        raise ValueError(
            "scene: expected one that can be simulated with its own gains, and has an "
            "equilibrium at its last set point, got one without."
        )
    if not (np.isfinite(start.loss) and np.isfinite(start.gradient).all()):
        raise unusable_loss()
    unit = max(float(start.loss), 1e-12)
    scale = 1 / np.sqrt(np.diag(start.curvature)[free] / unit + _FLAT)

    def at(x: np.ndarray) -> Evaluation:
        z = first.copy()
        z[free] = scale * x[:-1]
        return evaluated(z)

    def priced(x: np.ndarray) -> tuple[float, np.ndarray]:
        value = np.nan_to_num(at(x).loss / unit, nan=_FAILED) + _PRICE * x[-1]
        return value, np.append(scale * at(x).gradient[free] / unit, _PRICE)

    def room(x: np.ndarray) -> np.ndarray:
        beyond = np.nan_to_num(at(x).facts["excess"][0], nan=_FAILED)
        return x[-1] - beyond - _WITHIN

    def room_slopes(x: np.ndarray) -> np.ndarray:
        slopes = at(x).facts["slopes"][0][:, free]
        return np.column_stack([-scale * slopes, np.ones(len(slopes))])

    worst = max(start.facts["excess"].max() + _WITHIN, 0.0)
    result = scipy.optimize.minimize(
        priced,
        np.append(first[free] / scale, worst),
        jac=True,
        method="SLSQP",
        bounds=[*zip(low[free] / scale, high[free] / scale), (0, None)],
        constraints={"type": "ineq", "fun": room, "jac": room_slopes},
        options={"maxiter": max_steps, "ftol": _ENOUGH},
    )

    def rank(point: tuple[np.ndarray, Evaluation]) -> tuple[float, float]:
        loss, worst = point[1].loss, point[1].facts["excess"].max() + _WITHIN
        excess, value = np.nan_to_num([worst, loss], nan=np.inf)
        return max(excess, 2 * _ENOUGH), value

    z, best = min(points, key=rank)
    return z, float(best.loss), f"{result.message}, {len(points)} evaluations"


class TunedWithin(Report):
    """A scene tuned within limits, and which limits it meets; prints itself.

    - `scene`: the scene with its tuned gains.
    - `loss`: loss with the tuned gains.
    - `start`: kp and kd at the start (2, n).
    - `lower`, `upper`: the bounds of kp and kd (2, n).
    - `message`: why the search stopped, in words.
    - `limit`, `joint`, `allowed`, `reached`: a row per limit: its name, the joint's
      name, and the allowed and the reached value [1, s, N or N m]; NaN if it does
      not settle. Margins are those of `analysis.margins`.
    - `met`: whether each limit is met.
    """

    scene: Scene
    loss: float
    start: Float[np.ndarray, "2 joint"]
    lower: Float[np.ndarray, "2 joint"]
    upper: Float[np.ndarray, "2 joint"]
    message: str
    limit: tuple[str, ...]
    joint: tuple[str, ...]
    allowed: Float[np.ndarray, " limit"]
    reached: Float[np.ndarray, " limit"]

    @property
    def gains(self) -> Float[np.ndarray, "2 joint"]:
        """The tuned kp and kd."""
        return gains_of(self.scene)

    @property
    def met(self) -> Bool[np.ndarray, " limit"]:
        """Returns which limits are met; margins are lower limits, all others upper."""
        least = np.array(self.limit) == "modulus margin"
        return np.where(
            least, self.reached >= self.allowed, self.reached <= self.allowed
        )

    def _rows(self) -> list[list[str]]:
        rows = gain_rows(
            gain_table(self.scene, self.start, self.gains, self.lower, self.upper)
        )
        rows.append(["", "limit", "reached", "", "", ""])
        limits = zip(self.limit, self.joint, self.allowed, self.reached, self.met)
        for name, joint, allowed, reached, met in limits:
            cells = [f"{allowed:.5g}", f"{reached:.5g}", "", ""]
            rows.append([f"{name} of {joint}", *cells, "met" if met else "not met"])
        return rows

    def _remarks(self) -> list[str]:
        count = f"{self.met.sum()} of {self.met.size} limits met"
        if not self.met.all():
            count += " (none found that meet all; these exceed them least)"
        return [f"loss {self.loss:.5g}, {count}; {self.message}"]


def tune_within(
    scene: Scene,
    limits: Limits,
    *,
    loss: Loss = tip_errors,
    factor: ArrayLike | None = None,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    max_steps: int = 50,
    report: Callable[[str], Any] | None = None,
) -> TunedWithin:
    """Minimises a scene's loss in its gains, within limits on how it responds.

    SciPy's sequential quadratic programming (SLSQP) searches, by the derivatives of the
    loss and of the largest excess over each limit in short spans of time and bands of
    frequency. It sees 1001 times and 200 frequencies; the report is measured as finely
    as the fastest mode asks for, so that a limit that is exceeded between them counts
    as not met.

    **Arguments:**

    - `scene`: a step, for instance: must hold exactly one `PDController`, and otherwise
      elements without a state of their own.
    - `limits`: a `Limits` [s, N or N m].
    - `loss`, `factor`, `bounds`: as in `tune`.
    - `max_steps`: greatest number of steps, which take one or a few evaluations each.
    - `report`: called with a line after each evaluation, for instance `print`.

    **Returns:** a `TunedWithin`, which says which limits are met. If no gains are found
    that meet all, it holds those whose greatest excess is least: positions at any time
    count as shares of the step, efforts and margins as shares of their limits. The
    excess is then spread over several limits; other gains may meet more of them.

    **Raises:** ValueError as `tune`, and if the arm has no equilibrium at the last set
    point.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1],
    ...                  gravity=0)
    >>> up = fj.references.JointMove([1.0], [1.0], fj.references.Travel(1.0))
    >>> pd = fj.PDController(kp=[4.0], kd=[1.0], limit=[np.inf], reference=up)
    >>> step = fj.Scene(arm, fj.State([0.0], [0.0]), (pd,), 2.0)
    >>> limits = fj.tuning.Limits(overshoot=0.05, effort=10)
    >>> found = fj.tuning.tune_within(step, limits, loss=fj.tuning.joint_errors)
    >>> found.met.tolist()
    [True, True]
    """
    instance("limits", limits, Limits)
    check_tuned("scene", scene, function("loss", loss))
    check_joints("limits.", limits, scene.linkage)
    controller_and_others(scene)
    start, lower, upper = bounds_of(scene, factor, bounds)
    max_steps = whole_number("max_steps", max_steps, 1)
    if report is not None:
        function("report", report, "a callable or None")
    limits = sized(limits, joints_of(scene.linkage))
    with_margins = bool(np.any(np.asarray(limits.modulus_margin) > 0))
    problem = with_full_size(scene), loss, lower > 0, limits, with_margins
    first, low, high = (
        np.log(np.where(lower > 0, gains, 1)).ravel() for gains in (start, lower, upper)
    )
    z, value, message = _search(
        Lanes(_lane, [[problem]]), first, low, high, max_steps, report
    )
    gains = np.where(
        lower > 0, np.clip(np.exp(z).reshape(lower.shape), lower, upper), 0
    )
    scene = with_gains(scene, jnp.asarray(gains))
    rows = list(measured(scene, limits))
    limit, joint, allowed, reached = zip(*rows) if rows else ((),) * 4
    return TunedWithin(
        scene=scene,
        loss=value,
        start=start,
        lower=lower,
        upper=upper,
        message=message,
        limit=limit,
        joint=joint,
        allowed=np.array(allowed),
        reached=np.array(reached),
    )
