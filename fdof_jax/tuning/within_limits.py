"""Tuning of gains within limits on the response."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from .. import Element, PDController, Scene, Solution, Values, field, simulate
from ..analysis import (
    closed_loop,
    equilibrium,
    loop_matrices,
    margins,
    open_loop,
    step_measures,
)
from ..checks import instance, real_array
from ..data import Report
from ..forces import Part
from ..linkage import joint_names, moving_joints
from .losses import (
    GainBox,
    Loss,
    bounds_of,
    checked,
    controller_of,
    demands,
    gain_jacobian,
    gains_of,
    residuals_of,
    tip_errors,
    unusable_loss,
    with_gains,
)
from .result import gain_rows, gain_table
from .search import Evaluation, Lanes, check_motion, check_search, sum_of_squares

# Excesses count by their largest in each span of times and in each band of frequencies:
# one largest of all would jump between peaks, which a search cannot follow.
_SPANS, _BANDS = 13, 8
_FREQUENCIES = 200
_MARGIN = "modulus margin"
_BAND = 0.02  # share of a step in which its response has settled
# The search aims this far within the limits, so that motions sampled more finely are
# within them too.
_WITHIN = 5e-4
# Price of the greatest excess, as a share of the loss at the start. The search exceeds
# no limit that it can meet, as long as the multipliers of all limits sum to less.
_PRICE = 100.0
# Relative decrease of the loss at which the search ends, and tolerance of its motions.
_ENOUGH, _TOLERANCE = 1e-6, 1e-7
# The unknowns are scaled to equal curvatures of the loss, at least this share of it.
_FLAT = 1e-2
_FAILED = 1e6  # loss and excess where the simulation fails
# Samples of the motion that is measured: at least so many, so that most scenes share a
# program, and one for each part of a radian of the fastest mode, between which cubics
# are exact to 1e-5.
_LEAST, _MOST, _TURN = 1000, 2**20, 0.25


class Limits(Part):
    """Limits on the response to a step, for `tune_within`.

    A joint's step leads from the start of the motion to where the arm rests at the last
    set point. Infinity, or a margin of 0, limits nothing. Give overshoot and settling
    time only for joints that step.

    **Arguments:** one value per joint or one for all.

    - `overshoot`: greatest excess over the step, as a share of it.
    - `settling_time`: time after which the joint stays within 2 % of the step [s].
    - `effort`: greatest effort that the controller demands [N or N m].
    - `modulus_margin`: least `analysis.Margins.modulus` of the loop where the step
      ends, from 0 to 1.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> fj.tuning.Limits(overshoot=0.05, settling_time=[0.5, 0.3, 0.3])
    Limits(overshoot=0.05, settling_time=[0.5, 0.3, 0.3], effort=inf, modulus_margin=0)
    """

    overshoot: Values = field(unit="", minimum=0, finite=False, default=jnp.inf)
    settling_time: Values = field(unit="s", minimum=0, finite=False, default=jnp.inf)
    effort: Values = field(unit="N or N m", above=0, finite=False, default=jnp.inf)
    modulus_margin: Values = field(unit="", minimum=0, default=0.0)


def excess(
    limits: Limits, scene: Scene, solution: Solution, with_margins: bool
) -> Array:
    """Largest excesses of a motion over its limits (m,), negative within them.

    Those of positions are shares of the step, others of their limits. The number of
    times must be a multiple of 13.
    """
    ts, rest = solution.ts, rest_of(scene)
    controller, others = controller_and_others(scene)
    share, _, still = step_shares(solution, rest)

    def at(t, share_now, demand):
        over = jnp.where(still, -1, share_now - 1 - limits.overshoot)
        # From the sample before, as the response may settle between both.
        late = (t + ts[1] > limits.settling_time) & ~still
        unsettled = jnp.where(late, jnp.abs(share_now - 1) - _BAND, -1)
        return jnp.stack([over, unsettled, jnp.abs(demand) / limits.effort - 1])

    demand = demands(controller, scene.linkage, solution)
    along = _largest(jax.vmap(at)(ts, share, demand), _SPANS)
    if not with_margins:
        return along
    A, B, C, _ = loop_matrices(scene.linkage, rest, controller, others, scene.t1)
    near = jax.vmap(lambda s: limits.modulus_margin * jnp.abs(s) - 1)
    return jnp.concatenate([along, _largest(near(sensitivity(A, B, C)), _BANDS)])


def _largest(values: Array, blocks: int) -> Array:
    """Returns the largest of each block of rows, at least -1, as one row."""
    parts = values.reshape(blocks, -1, *values.shape[1:])
    return jnp.maximum(parts.max(axis=1), -1).reshape(-1)  # finite without a limit


def controller_and_others(scene: Scene) -> tuple[PDController, tuple[Element, ...]]:
    controller = controller_of(scene)
    return controller, tuple(e for e in scene.forces if e is not controller)


def rest_of(scene: Scene) -> Array:
    """The arm's rest at the last set point (n,) [m or rad], or NaN."""
    last, *_ = controller_of(scene).schedule(jnp.asarray(scene.t1), scene.linkage)
    return equilibrium(scene.linkage, last, scene.forces, scene.t1)


def step_shares(solution: Solution, rest: Array) -> tuple[Array, Array, Array]:
    """Returns changes and speeds as shares of the step, and which joints have none."""
    height = rest - solution.q[0]
    still = height == 0
    height = jnp.where(still, 1, height)
    changes = jax.vmap(lambda q: (q - solution.q[0]) / height)(solution.q)
    return changes, jax.vmap(lambda qd: qd / height)(solution.qd), still


def sensitivity(A: Array, B: Array, C: Array) -> Array:
    """Computes 1 / (1 + L) of each joint's loop (frequency, joint)."""
    n = B.shape[1]
    joints = jnp.arange(n)
    own = jnp.sqrt(jnp.abs(C[joints, joints] * B[n + joints, joints])) + 1e-3
    low, high = jnp.log(0.05 * own.min()), jnp.log(30 * own.max())
    w = jax.lax.stop_gradient(jnp.exp(jnp.linspace(low, high, _FREQUENCIES)))

    def at(w):
        closed = jnp.linalg.solve(1j * w * jnp.eye(len(A)) - A, B + 0j)
        return 1 - jnp.diagonal(C @ closed)

    return jax.vmap(at)(w)


def measured(scene: Scene, limits: Limits) -> Iterator[tuple[str, str, float, float]]:
    """Measures the motion finely; yields a row of `TunedWithin` per limit."""
    controller, others = controller_and_others(scene)
    limits = jax.tree.map(np.asarray, limits)
    linkage, t1, rest = scene.linkage, float(scene.t1), rest_of(scene)
    moving, names = moving_joints(linkage), joint_names(linkage)
    of_joint = lambda system, k: system(linkage, rest, controller, k + 1, others, t1)
    fastest = np.abs(of_joint(closed_loop, moving[0]).poles()).max()
    ts = np.linspace(0, t1, _samples_of(t1, fastest) + 1)
    motion = simulate(scene, ts, throw=False)
    shares, speeds, _ = map(np.asarray, step_shares(motion, rest))
    efforts = np.abs(demands(controller, linkage, motion)).max(axis=0)
    for k in moving:
        joint = names[k]
        overshoot, _, settled = step_measures(ts, shares[:, k], speeds[:, k], 1.0)
        unit = "N m" if joint[0] == "R" else "N"
        rows = (
            ("overshoot", limits.overshoot, overshoot),
            ("settling time [s]", limits.settling_time, settled),
            (f"effort [{unit}]", limits.effort, efforts[k]),
        )
        for label, most, value in rows:
            if most[k] < np.inf:
                yield label, joint, float(most[k]), float(value)
        if limits.modulus_margin[k] > 0:
            least = float(limits.modulus_margin[k])
            yield _MARGIN, joint, least, margins(of_joint(open_loop, k)).modulus


def _samples_of(t1: float, fastest: float) -> int:
    """Returns how many samples up to `t1` resolve the fastest mode [rad/s]."""
    count = t1 * fastest / _TURN
    if not count < _MOST:
        raise ValueError(
            f"scene.t1: expected at most {_MOST * _TURN / fastest:.3g} s for modes as "
            f"fast as {fastest:.3g} rad/s, got {t1:g} s."
        )
    return max(int(count), _LEAST)


def _lane(z: Array, problem: tuple[Scene, Loss, Limits, bool]) -> Evaluation:
    """Evaluates a loss and the excess over limits for log-factors z (2n,)."""
    scene, loss, limits, with_margins = problem

    def residuals(scene, solution):
        over = excess(limits, scene, solution, with_margins)
        return jnp.concatenate([over, residuals_of(loss, scene, solution)])

    found = gain_jacobian(z, scene, residuals, _TOLERANCE)
    count = scene.linkage.mass.size * (3 * _SPANS + with_margins * _BANDS)
    over, errors = jnp.split(found.residuals, [count])
    slopes, jacobian = jnp.split(found.jacobian, [count])
    own = found._replace(residuals=errors, jacobian=jacobian)
    return sum_of_squares(own, excess=over, slopes=slopes)


def _search(
    scene: Scene,
    lanes: Lanes,
    box: GainBox,
    max_steps: int,
    report: Callable[[str], object] | None,
) -> tuple[np.ndarray, float, str]:
    """Returns the best log-factors (2n,), their loss, and why the search stopped.

    Its unknowns are the scaled logarithms, and the greatest excess over the limits. As
    this has a price, limits that cannot be met are exceeded least.
    """
    first, low, high = box.logs()
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
        check_motion("scene", scene, [0.0, float(scene.t1)])
        raise ValueError(
            "scene: expected an equilibrium at its last set point, got none."
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
        over = np.nan_to_num(at(x).facts["excess"][0], nan=_FAILED)
        return x[-1] - over - _WITHIN

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
    - `loss`: its loss.
    - `start`, `lower`, `upper`: kp and kd at the start, and their bounds (2, n).
    - `message`: why the search stopped.
    - `limit`, `joint`, `allowed`, `reached`: for each limit, its name, the joint's
      name, and the allowed and the reached value [1, s, N or N m]. The latter is NaN if
      the joint does not settle or its loop is unstable.
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
        return np.asarray(gains_of(self.scene))

    @property
    def met(self) -> Bool[np.ndarray, " limit"]:
        """Returns whether limits are met: margins are lower limits, others upper."""
        sign = np.where(np.array(self.limit) == _MARGIN, -1, 1)
        return sign * self.reached <= sign * self.allowed

    def _rows(self) -> list[list[str]]:
        box = GainBox(self.start, self.lower, self.upper)
        rows = gain_rows(gain_table(self.scene, box, self.gains))
        rows.append(["", "limit", "reached", "", "", ""])
        limits = zip(self.limit, self.joint, self.allowed, self.reached, self.met)
        for name, joint, *values, met in limits:
            cells = [f"{value:.5g}" for value in values]
            mark = "met" if met else "not met"
            rows.append([f"{name} of {joint}", *cells, "", "", mark])
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
    report: Callable[[str], object] | None = None,
) -> TunedWithin:
    """Minimises a scene's loss over its gains, within limits on its response.

    SciPy's sequential quadratic programming (SLSQP) sees 1001 times and 200
    frequencies. The result is measured as finely as its fastest mode requires: a limit
    exceeded between these samples counts as not met.

    **Arguments:**

    - `scene`: with exactly one `PDController`, and without elements that have a state.
    - `limits`: a `Limits` [s, N or N m].
    - `loss`, `factor`, `bounds`, `report`: as in `tune`.
    - `max_steps`: greatest number of steps, of one or a few evaluations each.

    **Returns:** a `TunedWithin`. If the search finds no gains that meet all limits, the
    result has those whose greatest excess is least. Excesses are shares of the step;
    those of efforts and margins are shares of their limits. Other gains may meet more
    limits.

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
    sized = checked("scene", scene, loss)
    n, given = scene.linkage.mass.size, limits.arguments().items()
    rules: Any = dict(shape=(n,), finite=False, broadcast=True, of=f"{n} joints")
    limits = Limits(*(real_array(f"limits.{k}", row, **rules) for k, row in given))
    rest_of(scene)  # raises for elements with a state
    box = bounds_of(scene, factor, bounds)
    max_steps = check_search(max_steps, report)
    with_margins = bool(np.any(np.asarray(limits.modulus_margin) > 0))
    problem = sized, loss, limits, with_margins
    lanes = Lanes(_lane, [[problem]])
    z, value, message = _search(scene, lanes, box, max_steps, report)
    scene = with_gains(scene, jnp.asarray(box.gains(z)))
    rows = list(measured(scene, limits))
    limit, joint, allowed, reached = zip(*rows) if rows else ((),) * 4
    return TunedWithin(
        scene=scene,
        loss=value,
        start=box.start,
        lower=box.lower,
        upper=box.upper,
        message=message,
        limit=limit,
        joint=joint,
        allowed=np.array(allowed),
        reached=np.array(reached),
    )
