"""Tuning of gains within limits, by augmented Lagrangians."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from ..base.checks import instance
from ..base.configuration import options_of_loops
from ..linkage.fields import check_joints, sized
from ..linkage.linkage import joints_of
from ..simulation.scene import Scene, with_full_size
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from .gain_table import as_html, as_text, gain_rows
from .gains import SAMPLES, bounds_of, check_tuned, residuals_of
from .limits import Limits, controller_and_others, excess, measured
from .losses import Loss, gains_of, tip_errors
from .result import TuneResult
from .tuning import tune

_SEARCHES = 12
# The searches aim this far within the limits, so that the last one ends within them.
_WITHIN = 1e-3
# A mean square excess of this weighs as much as the loss at the start.
_EXCESS = 1e-5
# A limit that is approached by less than this factor per search weighs more.
_PROGRESS, _HEAVIER = 0.25, 5.0
# The searches end if the loss falls by less than this part, within the limits.
_SAME = 1e-3


class _Penalised(eqx.Module):
    """A loss with a penalty on what is beyond limits: an augmented Lagrangian.

    The multipliers are 2 `weight` * `shift` per sample.
    """

    loss: Any
    limits: Limits
    shift: Array
    weight: Array
    with_margins: bool = eqx.field(static=True)

    def __call__(self, scene: Scene, solution: Solution) -> Array:
        beyond = excess(self.limits, scene, solution, self.with_margins)
        beyond = beyond + _WITHIN + self.shift
        penalty = jnp.sqrt(self.weight / SAMPLES) * jnp.maximum(beyond, 0)
        own = residuals_of(self.loss, scene, solution)
        return jnp.concatenate([own, penalty])


@eqx.filter_jit(compiler_options=options_of_loops())  # pyright: ignore[reportCallIssue]
def _judged(
    scene: Scene, motion: Solution, loss: Loss, limits: Limits, with_margins: bool
) -> tuple[Array, Array]:
    """Returns the loss of a scene's motion, and how far it is beyond limits."""
    value = jnp.sum(residuals_of(loss, scene, motion) ** 2)
    return value, excess(limits, scene, motion, with_margins)


class TunedWithin(eqx.Module):
    """A scene tuned within limits, and which limits it meets; prints itself.

    - `scene`: the scene with its tuned gains.
    - `loss`: loss with the tuned gains, without any penalty.
    - `start`: kp and kd at the start (2, n).
    - `search`: the search that led there, whose loss includes the penalty.
    - `limit`, `joint`, `allowed`, `reached`: a row per limit: its name, the joint's
      name, and the allowed and the reached value [1, s, N or N m]; NaN if it does
      not settle. Margins are those of `analysis.margins`.
    - `met`: whether each limit is met.
    """

    scene: Scene
    loss: float
    start: Float[np.ndarray, "2 joint"]
    search: TuneResult
    limit: tuple[str, ...]
    joint: tuple[str, ...]
    allowed: Float[np.ndarray, " limit"]
    reached: Float[np.ndarray, " limit"]

    @property
    def gains(self) -> Float[np.ndarray, "2 joint"]:
        """The tuned kp and kd."""
        return self.search.gains

    @property
    def met(self) -> Bool[np.ndarray, " limit"]:
        """Returns which limits are met; margins are lower limits, all others upper."""
        least = np.array(self.limit) == "modulus margin"
        return np.where(
            least, self.reached >= self.allowed, self.reached <= self.allowed
        )

    def _rows(self) -> list[list[str]]:
        rows = gain_rows(self.search.table | {"start": self.start.ravel().tolist()})
        rows.append(["", "limit", "reached", "", "", ""])
        limits = zip(self.limit, self.joint, self.allowed, self.reached, self.met)
        for name, joint, allowed, reached, met in limits:
            cells = [f"{allowed:.5g}", f"{reached:.5g}", "", ""]
            rows.append([f"{name} of {joint}", *cells, "met" if met else "not met"])
        return rows

    @property
    def _verdict(self) -> str:
        count = f"{self.met.sum()} of {self.met.size} limits met"
        if not self.met.all():
            count += " (no search met all; this one exceeds them least)"
        return f"loss {self.loss:.5g}, {count}; its search: {self.search.message}"

    def __str__(self) -> str:
        return as_text(self._rows(), [self._verdict])

    def _repr_html_(self) -> str:
        return as_html(self._rows(), [self._verdict])


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

    Runs `tune` several times, in one compiled program, with a penalty on times and
    frequencies that are beyond a limit: the method of augmented Lagrangians. Its prices
    are adjusted until the limits are met, and no further. The searches see 1001 times
    and 200 frequencies; the report is measured as finely as the fastest mode asks for,
    so that a limit that is exceeded between them counts as not met.

    **Arguments:**

    - `scene`: a step, for instance: must hold exactly one `PDController`, and otherwise
      elements without a state of their own.
    - `limits`: a `Limits` [s, N or N m].
    - `loss`, `factor`, `bounds`, `report`: as in `tune`.
    - `max_steps`: greatest number of evaluations of each search after the first.

    **Returns:** a `TunedWithin`, which says which limits are met. If no search meets
    all, it holds the one whose greatest excess is least: positions at any time count as
    shares of the step, efforts and margins as shares of their limits. The excess is
    then spread over several limits; other gains may meet more of them.

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
    check_tuned("scene", scene, loss)
    check_joints("limits.", limits, scene.linkage)
    controller_and_others(scene)
    _, lower, upper = bounds_of(scene, factor, bounds)
    limits = sized(limits, joints_of(scene.linkage))
    with_margins = bool(np.any(np.asarray(limits.modulus_margin) > 0))
    start = gains_of(scene)

    def judged(scene: Scene) -> tuple[float, np.ndarray]:
        here = with_full_size(scene)._replace(t1=jnp.asarray(scene.t1, float))
        # By a plain call, whose program compiles in a third of the time.
        ts = np.linspace(0, scene.t1, SAMPLES)
        motion = simulate(here.linkage, here.state0, ts, here.forces, throw=False)
        value, beyond = _judged(here, motion, loss, limits, with_margins)
        return float(value), np.asarray(beyond)

    value, beyond = judged(scene)
    if np.isnan(beyond).any():
        raise ValueError(
            "scene: expected one that can be simulated with its own gains, and has an "
            "equilibrium at its last set point, got one without."
        )
    weight = max(value, 1e-12) / _EXCESS
    shift, before = np.zeros_like(beyond), (np.inf, np.inf)
    tried: list[tuple[float, float, Scene, TuneResult]] = []
    for _ in range(_SEARCHES):
        priced = _Penalised(
            loss, limits, jnp.asarray(shift), jnp.asarray(weight), with_margins
        )
        found = tune(
            scene, loss=priced, bounds=(lower, upper), max_steps=max_steps,
            report=report,
        )  # fmt: skip
        scene = found.scene
        value, beyond = judged(scene)
        worst = beyond.max()
        tried.append((max(worst, 0.0), value, scene, found))
        if worst <= 0 and value > (1 - _SAME) * before[0]:
            break
        shift = np.maximum(beyond + _WITHIN + shift, 0)
        if worst > max(_PROGRESS * before[1], 0):
            weight, shift = weight * _HEAVIER, shift / _HEAVIER
        before = value, worst
    _, value, scene, found = min(tried, key=lambda row: row[:2])
    rows = list(measured(scene, limits))
    limit, joint, allowed, reached = zip(*rows) if rows else ((),) * 4
    return TunedWithin(
        scene=scene,
        loss=value,
        start=start,
        search=found,
        limit=limit,
        joint=joint,
        allowed=np.array(allowed),
        reached=np.array(reached),
    )
