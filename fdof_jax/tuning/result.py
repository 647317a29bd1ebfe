"""Results of gain tuning."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float

from .. import Linkage, Scene
from ..data import Report
from ..linkage import joint_names, moving_joints
from .losses import GainBox, controller_of, with_gains
from .search import Run, best_of

# Joints with actuators at their limits for a larger share of the time are hardly
# controlled.
_MOSTLY = 0.9


class History(eqx.Module):
    """The course of a run: an entry for its start and one per accepted point.

    - `loss`: in [m^2] with the default loss.
    - `gradient_norm`: norm of the projected gradient in the logarithms of the gains.
    - `gains`: kp and kd, in joint order [N/m or N m/rad, N s/m or N m s/rad].
    - `saturated`: share of the time that each actuator is at its limit.
    - `effort`: root mean square of each effort over its limit.
    - `tip_error`: rms tip error [m]; NaN for a reference without a `tip`.
    - `wall_time`: time since the search began, compilation included [s].

    `saturated`, `effort` and the square of `tip_error` are means over an ensemble.
    """

    loss: Float[np.ndarray, " iteration"]
    gradient_norm: Float[np.ndarray, " iteration"]
    gains: Float[np.ndarray, "iteration 2 joint"]
    saturated: Float[np.ndarray, "iteration joint"]
    effort: Float[np.ndarray, "iteration joint"]
    tip_error: Float[np.ndarray, " iteration"]
    wall_time: Float[np.ndarray, " iteration"]


class TuneResult(Report):
    """A tuned scene and how it was reached; prints itself as a table.

    - `scene`: the scene with its tuned gains.
    - `loss`: its loss [m^2 with the default loss].
    - `histories`: a `History` per run; the first run starts from the scene's own gains.
    - `lower`, `upper`: the bounds of kp and kd (2, n).
    - `converged`: whether all of this holds: the run stopped by itself; no actuator was
      at its limit for more than 90 % of the time; a change of the gains by 1 %, within
      the bounds, would change the loss by less than 0.01 %, to first order.
    - `message`: why the run stopped, and warnings.
    - `member_loss`, `member_tip_error`: loss and rms tip error [m] of each member of
      the ensemble (member,).
    - `settings`: method, solver, tolerance, samples and dtype of the run.
    """

    scene: Scene
    loss: float
    histories: list[History]
    lower: Float[np.ndarray, "2 joint"]
    upper: Float[np.ndarray, "2 joint"]
    converged: bool
    message: str
    member_loss: Float[np.ndarray, " member"]
    member_tip_error: Float[np.ndarray, " member"]
    settings: Mapping[str, object]

    @property
    def _box(self) -> GainBox:
        return GainBox(self.histories[0].gains[0], self.lower, self.upper)

    @property
    def history(self) -> History:
        """The history of the best run."""
        return self.histories[int(np.nanargmin(self.losses))]

    @property
    def losses(self) -> Float[np.ndarray, " start"]:
        """Least loss of each run; NaN where its start could not be simulated."""
        return np.array([history.loss[-1] for history in self.histories])

    @property
    def gains(self) -> Float[np.ndarray, "2 joint"]:
        """The tuned kp and kd."""
        return self.history.gains[-1]

    @property
    def at_bound(self) -> Bool[np.ndarray, "2 joint"]:
        """True for each gain that a bound holds."""
        return self._box.at_bound(self.gains)

    @property
    def tip_error(self) -> float:
        """Rms tip error [m]; NaN for a reference without a `tip`."""
        return float(self.history.tip_error[-1])

    @property
    def effort(self) -> float:
        """Root mean square of efforts over their limits, over time and joints."""
        return _mean_effort(self.scene.linkage, self.history.effort[-1])

    @property
    def tuned_gains(self) -> int:
        """Number of gains that are tuned: those whose bounds differ."""
        return self._box.free

    @property
    def table(self) -> dict[str, list]:
        """Columns with one row per gain, for `pandas.DataFrame(result.table)`.

        They are `gain` (kp or kd), `joint`, `unit`, `start`, `tuned`, the bounds
        `least` and `greatest`, and `at_bound`.
        """
        return gain_table(self.scene, self._box, self.gains)

    def _rows(self) -> list[list[str]]:
        rows = gain_rows(self.table)
        first, last = self.histories[0], self.history
        comparisons = [("loss", first.loss[0], last.loss[-1])]
        if np.isfinite(self.tip_error):
            error = first.tip_error[0], last.tip_error[-1]
            of = " of all members" if len(self.member_loss) > 1 else ""
            label = f"rms tip error{of} [mm]"
            comparisons.append((label, 1e3 * error[0], 1e3 * error[1]))
        shares = 100 * first.saturated[0], 100 * last.saturated[-1]
        for name, *share in zip(joint_names(self.scene.linkage), *shares):
            comparisons.append((f"{name} at its limit [%]", *share))
        return rows + [
            [label, f"{before:.5g}", f"{after:.5g}", "", "", ""]
            for label, before, after in comparisons
        ]

    def _remarks(self) -> list[str]:
        rows, losses = [], self.losses
        if failed := np.isnan(losses).sum():
            rows.append(f"{failed} of {len(losses)} starts could not be simulated")
        if len(losses) > 1:
            near = np.sum(losses**0.5 <= 1.01 * self.loss**0.5)
            rows.append(
                f"{near} of {len(losses)} starts within 1 % of the best in the root of "
                "the loss"
            )
        if len(self.member_loss) > 1:
            what, values = "root of the loss", np.sqrt(self.member_loss)
            if np.isfinite(self.tip_error):
                what, values = "rms tip error [mm]", 1e3 * self.member_tip_error
            rows.append(
                f"{what} over {len(values)} members: {values.min():.5g} to "
                f"{values.max():.5g}"
            )
        iterations = len(self.history.loss) - 1
        rows.append(f"{self._outcome}, {iterations} iterations: {self.message}")
        return rows

    @property
    def _outcome(self) -> str:
        return f"{'' if self.converged else 'not '}converged"

    def __repr__(self) -> str:
        """One line, or shapes if values are traced."""
        first = self.histories[0]
        if isinstance(first.loss, Tracer) or not isinstance(self.loss, float):
            return super().__repr__()
        topology = "".join(name[0] for name in joint_names(self.scene.linkage))
        held = int(self.at_bound.sum())
        return (
            f"TuneResult({topology}, loss {first.loss[0]:.5g} to {self.loss:.5g}, "
            f"{held} of {self.tuned_gains} gains at a bound, {self._outcome})"
        )


def gain_rows(table: dict[str, list]) -> list[list[str]]:
    """Returns a header, and a row per gain of a `TuneResult.table`."""
    rows = [["", "start", "tuned", "least", "greatest", ""]]
    for gain, joint, unit, *values, held in zip(*table.values()):
        cells = [f"{value:.5g}" for value in values]
        mark = "at its bound" if held else ""
        rows.append([f"{gain} of {joint} [{unit}]", *cells, mark])
    return rows


def gain_table(scene: Scene, box: GainBox, tuned: np.ndarray) -> dict[str, list]:
    """Returns the columns of `TuneResult.table`."""
    names = joint_names(scene.linkage)
    units = {"F": ("", "")} | controller_of(scene).gain_units
    start, lower, upper = box
    values = dict(start=start, tuned=tuned, least=lower, greatest=upper)
    values["at_bound"] = box.at_bound(tuned)
    return {
        "gain": ["kp"] * len(names) + ["kd"] * len(names),
        "joint": names * 2,
        "unit": [units[name[0]][kind] for kind in range(2) for name in names],
    } | {name: np.ravel(value).tolist() for name, value in values.items()}


def _mean_effort(linkage: Linkage, efforts: np.ndarray) -> float:
    """Returns the root mean square of efforts (n,) over the moving joints."""
    return float(np.sqrt(np.mean(efforts[moving_joints(linkage)] ** 2)))


def _history(run: Run, box: GainBox) -> History:
    rows: Any = jax.tree.map(lambda *values: np.stack(values), *run.rows)
    # Means over the members.
    mean = {name: np.mean(values, axis=1) for name, values in rows.facts.items()}
    return History(
        loss=rows.loss,
        gradient_norm=rows.gradient_norm,
        gains=box.gains(rows.z),
        saturated=mean["saturated"],
        effort=mean["effort"],
        tip_error=np.sqrt(mean["square_error"]),
        wall_time=rows.wall_time,
    )


def result_of(
    scene: Scene, runs: list[Run], box: GainBox, settings: Mapping[str, object]
) -> TuneResult:
    """The result of one scene's runs, taken from the best."""
    run, histories = best_of(runs), [_history(run, box) for run in runs]
    history = histories[runs.index(run)]
    return TuneResult(
        scene=with_gains(scene, jnp.asarray(history.gains[-1])),
        loss=run.best.loss,
        histories=histories,
        lower=box.lower,
        upper=box.upper,
        converged=run.converged and history.saturated[-1].max() <= _MOSTLY,
        message=_message(scene, run, history, box),
        member_loss=run.best.facts["member_loss"],
        member_tip_error=np.sqrt(run.best.facts["square_error"]),
        settings=settings,
    )


def _message(scene: Scene, run: Run, history: History, box: GainBox) -> str:
    """Why the run stopped, and what only looks like convergence."""
    reason = run.reason
    if run.flat:
        reason = "the gradient is zero at the start"
        if history.saturated[0, moving_joints(scene.linkage)].min() == 1:
            reason += ", because every actuator is at its limit throughout"
    held = np.sum(box.at_bound(history.gains[-1]))
    bounds = f"{held} of {box.free} gains are at a bound"
    if held:
        bounds += " (widen the bounds, price the effort, or take another controller)"
    parts = [reason, bounds]
    for name, share in zip(joint_names(scene.linkage), history.saturated[-1]):
        if share > _MOSTLY:
            parts.append(
                f"{name} is at its limit for {100 * share:.4g} % of the time, so its "
                "gains have hardly any effect"
            )
    return "; ".join(parts)
