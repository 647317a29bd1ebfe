"""Minimisation within bounds by derivatives, many runs at once.

The functions are evaluated for all runs that still go on together; what comes here is
the little that follows an evaluation, on the host.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from ..checks import whole_number

# Stop where a change of the unknowns by 1 would hardly change the loss, to first order.
_GRADIENT_OF_LOSS = 1e-6
# Where the loss itself can vanish, its gradient is compared with that at the start.
_GRADIENT_DECREASE = 1e-10
# What the projected gradient must have fallen to for a stop for another reason to count
# as convergence: part of the loss.
_CONVERGED = 1e-2
# No step changes an unknown by more: a factor of 7 where unknowns are logarithms.
_LONGEST_STEP = 2.0


class Evaluation(NamedTuple):
    """A function at one point per run.

    - `loss` (run,); `gradient` (run, n); `curvature` (run, n, n): semidefinite, Gauss
      and Newton's for instance.
    - `facts`: arrays (run, ...) to be kept with the point.
    """

    loss: Any
    gradient: Any
    curvature: Any
    facts: dict[str, Any]

    def row(self, index: int) -> "Evaluation":
        return jax.tree.map(lambda a: a[index], self)


class Row(NamedTuple):
    """An accepted point of a run: `gradient_norm` without what bounds hold back."""

    z: np.ndarray
    loss: float
    gradient_norm: float
    facts: dict[str, np.ndarray]
    wall_time: float


class LevenbergMarquardt:
    """Steps of the damped quadratic model in the box, which only ever go down.

    Along a flat valley whose floor the model takes for curved, steps come out short
    again and again: after one that brings more than it promised the next is stretched.
    """

    def __init__(self, z: np.ndarray):
        self.damping, self.growth, self.stretch = 1e-3, 4, 1
        self.promised = 0.0

    def step(self, z, here: Evaluation, low, high) -> np.ndarray:
        normal = here.curvature.copy()
        scale = np.diag(normal)
        normal += np.diag(self.damping * scale + 1e-12 * scale.sum() + 1e-300)
        step = box_minimum(normal, here.gradient, low - z, high - z)
        self.promised = -(here.gradient @ step + step @ here.curvature @ step / 2)
        return np.clip(self.stretch * step, low - z, high - z)

    def accepted(self, decrease: float) -> None:
        more = decrease > 1.2 * self.promised
        self.stretch = min(2 * self.stretch, 4) if more else 1
        self.damping, self.growth = max(self.damping / 4, 1e-9), 4

    def refused(self) -> bool:
        """Whether there is anything left to try."""
        if self.stretch > 1:
            self.stretch = 1
            return True
        self.damping *= self.growth
        self.growth *= 2
        return self.damping <= 1e8


class LBFGS:
    """optax's L-BFGS directions, within the box by projection, halved until down."""

    def __init__(self, z: np.ndarray):
        import optax  # slow to import, and not needed by the default method

        self.optimiser = optax.scale_by_lbfgs()
        self.update = jax.jit(self.optimiser.update)
        self.state: Any = self.optimiser.init(jnp.asarray(z))
        self.direction: np.ndarray | None = None
        self.share = 1.0

    def step(self, z, here: Evaluation, low, high) -> np.ndarray:
        held = _held(z, here.gradient, low, high)
        if self.direction is None:
            update, self.state = self.update(
                jnp.asarray(here.gradient), self.state, jnp.asarray(z)
            )
            self.direction = -np.asarray(update)
        direction = np.where(held, 0, self.direction)
        if direction @ here.gradient >= 0:
            direction = np.where(held, 0, -here.gradient)
        # The first direction is the gradient itself, whose length says nothing.
        if int(self.state.count) == 1:
            direction = 0.3 * direction / np.abs(direction).max()
        return np.clip(z + self.share * direction, low, high) - z

    def accepted(self, decrease: float) -> None:
        self.direction, self.share = None, 1.0

    def refused(self) -> bool:
        self.share /= 4
        return self.share > 1e-8


class Adam:
    """optax's Adam, clipped to the box; its loss may rise on the way."""

    def __init__(self, z: np.ndarray):
        import optax

        self.optimiser = optax.adam(0.05)
        self.state: Any = self.optimiser.init(jnp.asarray(z))

    def step(self, z, here: Evaluation, low, high) -> np.ndarray:
        update, self.state = self.optimiser.update(
            jnp.asarray(here.gradient), self.state
        )
        return np.clip(z + np.asarray(update), low, high) - z

    def accepted(self, decrease: float) -> None:
        pass


METHODS: dict[str, Any] = {
    "levenberg-marquardt": LevenbergMarquardt,
    "l-bfgs": LBFGS,
    "adam": Adam,
}


def box_minimum(
    matrix: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Where slope @ x + x @ matrix @ x / 2 is least in a box, of a definite matrix.

    Unknowns without room are 0.
    """
    result = np.zeros_like(slope)
    room = low < high
    if not room.any():
        return result
    # Of unit diagonal: unknowns of any size are alike to the factorisation.
    scale = 1 / np.sqrt(np.diag(matrix)[room])
    normal = matrix[np.ix_(room, room)] * scale[:, None] * scale
    problem = normal, slope[room] * scale, low[room] / scale, high[room] / scale
    found = _by_sets(*problem)
    if found is None:
        found = _by_bvls(*problem)
    # Bounds that hold are met exactly, whatever the scaling rounds.
    _, _, lowest, highest = problem
    inside = np.clip(found * scale, low[room], high[room])
    result[room] = np.where(
        found <= lowest, low[room], np.where(found >= highest, high[room], inside)
    )
    return result


def _by_sets(normal, slope, low, high) -> np.ndarray | None:
    """By guesses of which bounds hold, each from the last, until one proves right.

    That takes few factorisations, where BVLS takes one per bound. None if it takes
    many: then it may never end.
    """
    below = above = np.zeros(slope.shape, bool)
    for _ in range(20):
        x = np.where(below, low, np.where(above, high, 0.0))
        free = ~(below | above)
        if free.any():
            factor = cho_factor(normal[np.ix_(free, free)])
            x[free] = cho_solve(factor, -(slope + normal @ x)[free])
        rise = slope + normal @ x
        sets = (x < low) | below & (rise > 0), (x > high) | above & (rise < 0)
        if (sets[0] == below).all() and (sets[1] == above).all():
            return x
        below, above = sets
    return None


def _by_bvls(normal, slope, low, high) -> np.ndarray:
    from scipy.optimize import lsq_linear  # hardly ever needed, and slow to import

    factor = cholesky(normal)
    target = -solve_triangular(factor, slope, trans=1)
    return lsq_linear(factor, target, (low, high), method="bvls", tol=1e-12).x


def _held(z, gradient, low, high) -> np.ndarray:
    return ((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0))


class Run:
    """One run: where it is, what it has passed, and why it has stopped, if it has."""

    def __init__(self, method: Any, enough: float, z, low, high):
        self.method, self.enough = method(z), enough
        self.z, self.low, self.high = z, low, high
        self.rows: list[Row] = []
        self.reason: str | None = None
        self.exhausted = False  # out of steps, before any other reason
        self.flat = False  # whether the gradient is zero at the start, bounds or not
        self.at: Evaluation | None = None

    def arrive(self, z: np.ndarray, here: Evaluation, began: float) -> None:
        """Take the result of an evaluation: accept the point or refuse it."""
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
        held = _held(z, here.gradient, self.low, self.high) | (self.low >= self.high)
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
        if self._small(norm, here.loss, _GRADIENT_OF_LOSS):
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
        low = np.maximum(self.low, self.z - _LONGEST_STEP)
        high = np.minimum(self.high, self.z + _LONGEST_STEP)
        step = self.method.step(self.z, self.at, low, high)
        # z + (high - z) may be beyond high by rounding.
        return np.clip(self.z + step, low, high)

    @property
    def best(self) -> Row:
        """Adam's last point need not be its best: what is said is said of the best."""
        return min(self.rows, key=lambda row: row.loss)

    @property
    def failed(self) -> bool:
        """Whether the function could not be evaluated at the start."""
        return not np.isfinite(self.rows[0].gradient_norm)

    @property
    def converged(self) -> bool:
        best = self.best
        small = self._small(best.gradient_norm, best.loss, _CONVERGED)
        return bool(not self.flat and not self.failed and not self.exhausted and small)


def reporting(
    report: Any, describe: Callable[[list[Run]], str]
) -> Callable[[int, list[Run]], None]:
    """What `minimise` tells of each step, as a line for the argument `report`.

    Raise ValueError if that is neither callable nor None.
    """
    if not (report is None or callable(report)):
        raise ValueError(f"report: expected a callable or None, got {report!r}.")

    def told(number: int, runs: list[Run]) -> None:
        if report is not None:
            going = sum(run.reason is None for run in runs)
            report(
                f"{number:4d}  {describe(runs)}, {going} of {len(runs)} runs going on"
            )

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
    """Minimise a function per run, from (run, n) starts within (run, n) bounds.

    Raise ValueError unless `max_steps` is a whole number of at least 1.

    **Arguments:** `evaluate`: `(z, runs)`, points of the runs with these indices, to
    their `Evaluation`; `method`: one of `METHODS`; `max_steps`: evaluations after the
    first; `enough`: a run stops where its loss falls by less than this part of itself;
    `report`: told the number of the step and the runs after each.
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
