"""Minimisation within bounds by derivatives, many runs at once.

All running functions are evaluated together. This module does the little work after an
evaluation, on the host.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..checks import whole_number
from .methods import (
    GRADIENT_OF_LOSS,
    LONGEST_STEP,
    METHODS,
    Adam,
    Evaluation,
    held_at_bounds,
)

# The loss may vanish, so its gradient is also compared with that at the start.
_GRADIENT_DECREASE = 1e-10
# A stop for another reason counts as convergence if the projected gradient is at most
# this part of the loss.
_CONVERGED = 1e-2


class Row(NamedTuple):
    """An accepted point of a run; `gradient_norm` is that of the projected gradient."""

    z: np.ndarray
    loss: float
    gradient_norm: float
    facts: dict[str, np.ndarray]
    wall_time: float


class Run:
    """A run: its point `z`, its accepted points `rows`, and its `reason` to stop."""

    def __init__(self, method: Any, enough: float, z, low, high):
        self.method, self.enough = method(z), enough
        self.z, self.low, self.high = z, low, high
        self.rows: list[Row] = []
        self.reason: str | None = None
        self.exhausted = False  # whether it stopped only for lack of steps
        self.flat = False  # whether the gradient at the start is zero, also at bounds
        self.at: Evaluation | None = None

    def arrive(self, z: np.ndarray, here: Evaluation, began: float) -> None:
        """Accepts or rejects the point `z` by its evaluation `here`."""
        finite = np.isfinite(here.loss) and np.isfinite(here.gradient).all()
        finite = finite and np.isfinite(here.curvature).all()
        adam = isinstance(self.method, Adam)
        if self.at is not None and not (finite and (adam or here.loss < self.at.loss)):
            if adam:
                self.reason = "a step led to where the simulation fails"
            elif not self.method.refused():
                self.reason = "no step decreases the loss any further"
            return
        if not finite:  # at the start
            self.reason = "the simulation or its derivative fails at the start"
            here = here._replace(loss=np.nan, gradient=np.full_like(z, np.nan))
        held = held_at_bounds(z, here.gradient, self.low, self.high)
        held |= self.low >= self.high
        norm = float(np.linalg.norm(np.where(held, 0, here.gradient)))
        before, self.at, self.z = self.at, here, z
        if before is None:
            self.flat = not here.gradient.any()
        self.rows.append(
            Row(z, float(here.loss), norm, here.facts, time.perf_counter() - began)
        )
        if self.reason is not None:
            return
        if before is not None:
            self.method.accepted(before.loss - here.loss)
        if self._small(norm, here.loss, GRADIENT_OF_LOSS):
            self.reason = "the projected gradient vanishes"
        elif before is not None and not adam:
            if before.loss - here.loss < self.enough * before.loss:
                self.reason = "the loss decreases no further"

    def _small(self, norm: float, loss: float, of_loss: float) -> bool:
        return norm <= max(
            _GRADIENT_DECREASE * self.rows[0].gradient_norm, of_loss * loss
        )

    def next(self) -> np.ndarray:
        assert self.at is not None
        low = np.maximum(self.low, self.z - LONGEST_STEP)
        high = np.minimum(self.high, self.z + LONGEST_STEP)
        step = self.method.step(self.z, self.at, low, high)
        # By rounding, z + (high - z) may exceed high.
        return np.clip(self.z + step, low, high)

    @property
    def best(self) -> Row:
        """The point of least loss, which need not be Adam's last."""
        return min(self.rows, key=lambda row: row.loss)

    @property
    def failed(self) -> bool:
        """Returns whether the function could not be evaluated at the start."""
        return not np.isfinite(self.rows[0].gradient_norm)

    @property
    def converged(self) -> bool:
        best = self.best
        small = self._small(best.gradient_norm, best.loss, _CONVERGED)
        return bool(not self.flat and not self.failed and not self.exhausted and small)


def reporting(
    report: Any, describe: Callable[[list[Run]], str]
) -> Callable[[int, list[Run]], None]:
    """Returns a callback for `minimise` that passes a line per step to `report`.

    Raises ValueError if `report` is neither callable nor None.
    """
    if not (report is None or callable(report)):
        raise ValueError(f"report: expected a callable or None, got {report!r}.")

    def told(number: int, runs: list[Run]) -> None:
        if report is not None:
            going = sum(run.reason is None for run in runs)
            report(f"{number:4d}  {describe(runs)}, {going} of {len(runs)} runs active")

    return told


def minimise(
    evaluate: Callable[[np.ndarray, np.ndarray], Evaluation],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    *,
    method: str,
    max_steps: int,
    enough: float,
    report: Callable[[int, list[Run]], None],
) -> list[Run]:
    """Minimises a function per run, from (run, n) starts within (run, n) bounds.

    **Arguments:** `evaluate`: `(z, runs) -> Evaluation`, for points `z` of the runs
    with indices `runs`; `method`: one of `METHODS`; `max_steps`: evaluations after the
    first; `enough`: a run stops when its loss falls by less than this part; `report`:
    called after each step with its number and the runs.

    **Raises:** ValueError unless `max_steps` is a whole number of at least 1.
    """
    max_steps = whole_number("max_steps", max_steps, 1)
    began = time.perf_counter()
    runs = [Run(METHODS[method], enough, *row) for row in zip(start, low, high)]
    for number in range(max_steps + 1):
        going = [i for i, run in enumerate(runs) if run.reason is None]
        if not going:
            break
        trials = [runs[i].next() if number else runs[i].z for i in going]
        found = evaluate(np.stack(trials), np.array(going))
        for place, (i, trial) in enumerate(zip(going, trials)):
            runs[i].arrive(trial, found.row(place), began)
        report(number, runs)
    for run in runs:
        if run.reason is None:
            run.exhausted, run.reason = True, f"stopped after {max_steps} evaluations"
    return runs
