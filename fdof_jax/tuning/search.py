"""Minimisation within bounds by derivatives, many runs at once."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from .. import Scene, Solution, simulate
from ..checks import check_joints, function, instance, whole_number
from ..simulation import Sensitivities, jit
from .stacks import stacked

# Greatest change of an unknown in a step: a factor of 7 if unknowns are logarithms.
_LONGEST_STEP = 2.0
# A run stops if, to first order, changing the unknowns by 1 hardly changes the loss.
_GRADIENT_OF_LOSS = 1e-6
# The loss may vanish, so its gradient is also compared with that at the start.
_GRADIENT_DECREASE = 1e-10
_PATIENCE = 10  # guesses of the active bounds of a step that are no better
# A stop for another reason counts as convergence if the projected gradient is at most
# this part of the loss.
_CONVERGED = 1e-2
# Greatest number of lanes in a compiled batch: fewer do not fill the processor, and
# more wait for each other.
_LANES = 8


class Evaluation(NamedTuple):
    """A function and its derivatives at one point per run.

    Loss (run,), gradient (run, n), semidefinite curvature (run, n, n); `facts` (run,
    ...) are kept with the point.
    """

    loss: Any
    gradient: Any
    curvature: Any
    facts: dict[str, Any]

    def row(self, index: int) -> "Evaluation":
        return jax.tree.map(lambda a: a[index], self)


Evaluate = Callable[[Array, Any], Evaluation]  # (z, problem) of one lane


class LevenbergMarquardt:
    """Steps to the minimum in the box of the damped quadratic model."""

    def __init__(self, z: np.ndarray):
        self.damping, self.growth = 1e-3, 4

    def step(self, z, here: Evaluation, low, high) -> np.ndarray:
        normal = here.curvature.copy()
        scale = np.diag(normal)
        normal += np.diag(self.damping * scale + 1e-12 * scale.sum() + 1e-300)
        return box_minimum(normal, here.gradient, low - z, high - z)

    def accepted(self) -> None:
        self.damping, self.growth = max(self.damping / 4, 1e-9), 4

    def refused(self) -> bool:
        """Shortens the next step; returns whether one is left to try."""
        self.damping *= self.growth
        self.growth *= 2
        return self.damping <= 1e8


class LBFGS:
    """optax's L-BFGS directions, projected into the box, shortened until descent."""

    def __init__(self, z: np.ndarray):
        import optax  # slow to import, and not needed by the default method

        self.optimiser = optax.scale_by_lbfgs()
        self.update = jax.jit(self.optimiser.update)
        self.state: PyTree = self.optimiser.init(jnp.asarray(z))
        self.direction: np.ndarray | None = None
        self.share = 1.0

    def step(self, z, here: Evaluation, low, high) -> np.ndarray:
        held = held_at_bounds(z, here.gradient, low, high)
        if self.direction is None:
            at = jnp.asarray(here.gradient), self.state, jnp.asarray(z)
            update, self.state = self.update(*at)
            self.direction = -np.asarray(update)
        direction = np.where(held, 0, self.direction)
        if direction @ here.gradient >= 0:
            direction = np.where(held, 0, -here.gradient)
        # The first direction is the gradient itself, whose length is arbitrary.
        if int(self.state.count) == 1:
            direction = 0.3 * direction / np.abs(direction).max()
        return np.clip(z + self.share * direction, low, high) - z

    def accepted(self) -> None:
        self.direction, self.share = None, 1.0

    def refused(self) -> bool:
        self.share /= 4
        return self.share > 1e-8


METHODS = {"levenberg-marquardt": LevenbergMarquardt, "l-bfgs": LBFGS}


def box_minimum(
    matrix: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Minimises slope @ x + x @ matrix @ x / 2 in a box, for a definite matrix.

    It guesses the active bounds until a guess proves right: block principal pivoting
    (Judice and Pires, 1994). With hundreds of nearly dependent unknowns it may fail;
    the search then rejects the step.
    """
    # It mostly takes a few factorisations, where SciPy's BVLS takes one per bound.
    x, below, above = np.zeros_like(slope), *np.zeros((2, slope.size), bool)
    least, patience = np.inf, _PATIENCE
    for _ in range(100 + 10 * slope.size):
        x = np.where(below, low, np.where(above, high, 0.0))
        free = ~(below | above)
        if free.any():
            factor = scipy.linalg.cho_factor(matrix[np.ix_(free, free)])
            x[free] = scipy.linalg.cho_solve(factor, -(slope + matrix @ x)[free])
        rise = slope + matrix @ x
        sets = (x < low) | below & (rise > 0), (x > high) | above & (rise < 0)
        wrong = (sets[0] != below) | (sets[1] != above)
        if not wrong.any():
            break
        better = wrong.sum() < least
        least, patience = (wrong.sum(), _PATIENCE) if better else (least, patience - 1)
        if patience < 0:  # all changes at once may cycle; the first one alone does not
            wrong[wrong.argmax() + 1 :] = False
        below, above = np.where(wrong, sets, (below, above))
    return np.clip(x, low, high)


def held_at_bounds(z, gradient, low, high) -> np.ndarray:
    return ((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0))


class Row(NamedTuple):
    """An accepted point of a run; `gradient_norm` is that of the projected gradient."""

    z: np.ndarray
    loss: float
    gradient_norm: float
    facts: dict[str, np.ndarray]
    wall_time: float


class Run:
    """A run: its point `z`, its accepted points `rows`, and its `reason` to stop."""

    def __init__(self, method: str, enough: float, z, low, high):
        self.method, self.enough = METHODS[method](z), enough
        self.z, self.low, self.high = z, low, high
        self.rows: list[Row] = []
        self.reason = ""  # while it runs
        self.exhausted = False  # whether it stopped only for lack of steps
        self.flat = False  # whether the gradient at the start is zero, also at bounds
        self.at: Any = None  # the evaluation at `z`

    def arrive(self, z: np.ndarray, here: Evaluation, began: float) -> None:
        """Accepts or rejects the point `z` by its evaluation `here`."""
        before = self.at
        finite = all(np.isfinite(value).all() for value in here[:3])
        if before is not None and not (finite and here.loss < before.loss):
            if not self.method.refused():
                self.reason = "no step decreases the loss any further"
            return
        if not finite:  # at the start
            self.reason = "the simulation or its derivative fails at the start"
            here = here._replace(loss=np.nan, gradient=np.full_like(z, np.nan))
        held = held_at_bounds(z, here.gradient, self.low, self.high)
        held |= self.low >= self.high
        norm = float(np.linalg.norm(np.where(held, 0, here.gradient)))
        self.at, self.z = here, z
        passed = time.perf_counter() - began
        self.rows.append(Row(z, float(here.loss), norm, here.facts, passed))
        if self._small(_GRADIENT_OF_LOSS):
            self.reason = "the projected gradient vanishes"
        if before is None:
            self.flat = not here.gradient.any()
            return
        self.method.accepted()
        if not self.reason and before.loss - here.loss < self.enough * before.loss:
            self.reason = "the loss decreases no further"

    def _small(self, of_loss: float) -> bool:
        # Whether the projected gradient is at most this part of the loss.
        least = _GRADIENT_DECREASE * self.rows[0].gradient_norm
        return self.best.gradient_norm <= max(least, of_loss * self.best.loss)

    def next(self) -> np.ndarray:
        low = np.maximum(self.low, self.z - _LONGEST_STEP)
        high = np.minimum(self.high, self.z + _LONGEST_STEP)
        step = self.method.step(self.z, self.at, low, high)
        # By rounding, z + (high - z) may exceed high.
        return np.clip(self.z + step, low, high)

    @property
    def best(self) -> Row:
        """The last point, as each accepted one decreases the loss."""
        return self.rows[-1]

    @property
    def failed(self) -> bool:  # at the start
        return not np.isfinite(self.best.loss)

    @property
    def converged(self) -> bool:
        stopped = not (self.flat or self.failed or self.exhausted)
        return stopped and self._small(_CONVERGED)


def best_of(runs: list[Run]) -> Run:
    """Returns the run of least loss; a failed one only if all have failed."""
    return min(runs, key=lambda run: (run.failed, run.best.loss))


def check_search(max_steps: int, report: Callable | None) -> int:
    """Returns `max_steps`; raises ValueError for malformed arguments."""
    if report is not None:
        function("report", report, "a callable or None")
    return whole_number("max_steps", max_steps, 1)


def minimise(
    evaluate: Callable[[np.ndarray, np.ndarray], Evaluation],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    *,
    method: str,
    max_steps: int,
    enough: float,
    report: Callable[[str], object] | None = None,
    describe: Callable[[list[Run]], str] = str,
) -> list[Run]:
    """Minimises a function per run, from (run, n) starts within (run, n) bounds.

    `evaluate` is called with points and the indices of their runs. A run stops when its
    loss falls by less than the part `enough`. `describe` says in a `report` where the
    runs are.
    """
    max_steps = check_search(max_steps, report)
    began = time.perf_counter()
    runs = [Run(method, enough, *row) for row in zip(start, low, high)]
    for number in range(max_steps + 1):
        going = [i for i, run in enumerate(runs) if not run.reason]
        if not going:
            break
        trials = [runs[i].next() if number else runs[i].z for i in going]
        found = evaluate(np.stack(trials), np.array(going))
        for place, (i, trial) in enumerate(zip(going, trials)):
            runs[i].arrive(trial, found.row(place), began)
        if report is not None:
            active = f", {len(going)} of {len(runs)} runs active" * (len(runs) > 1)
            report(f"{number:4d}  {describe(runs)}{active}")
    for run in runs:
        if not run.reason:
            run.exhausted = True
            run.reason = f"stopped after {max_steps} evaluations (max_steps)"
    return runs


def check_motion(name: str, scene: Scene, ts: ArrayLike) -> None:
    """Raises ValueError with the reason if a scene cannot be simulated over `ts`."""
    try:
        simulate(scene, ts)
    except RuntimeError as error:
        message = f"{name}: expected one that can be simulated from its start. {error}"
        raise ValueError(message) from error


def check_solution(scene: Scene, solution: Solution) -> None:
    instance("scene", scene, Scene)
    check_joints("solution", solution, scene.linkage)


def sum_of_squares(found: Sensitivities, **facts: Array) -> Evaluation:
    """The sum of squared residuals, its gradient and Gauss-Newton's curvature."""
    value, jacobian, *_ = found
    loss, curvature = jnp.sum(value**2), 2 * jacobian.T @ jacobian
    return Evaluation(loss, 2 * jacobian.T @ value, curvature, facts)


@jit
def _evaluate(
    evaluate: Evaluate, z: Array | np.ndarray, moving: PyTree, problem: PyTree
) -> Evaluation:
    """Evaluates lanes along the leading axis of `z` and `moving`."""

    def lane(z, moving):
        return evaluate(z, eqx.combine(moving, problem))

    if len(z) > 1:
        return jax.vmap(lane)(z, moving)
    # A single lane is compiled without a batch, which is faster.
    one = lane(*jax.tree.map(lambda a: a[0], (z, moving)))
    return jax.tree.map(lambda a: a[None], one)


def _moves(leaf: object) -> bool:
    """Returns whether an array differs along its axes (run, member)."""
    return isinstance(leaf, np.ndarray) and bool((leaf != leaf[:1, :1]).any())


class Lanes:
    """Evaluates runs by one compiled program, in groups of lanes."""

    def __init__(
        self,
        evaluate: Evaluate,
        problems: list[list[PyTree]],
        starts: int = 1,
        order: int = 1,
    ):
        """`problems`: equally many members per row; `order`: of the power mean."""
        self.evaluate, self.order = evaluate, order
        every = stacked([stacked(members) for members in problems])
        # Values common to all lanes are not batched, so XLA computes with them once.
        moving, shared = eqx.partition(every, _moves)
        common = lambda a: jnp.asarray(a[0, 0]) if isinstance(a, np.ndarray) else a
        self.shared = jax.tree.map(common, shared)
        self.moving = jax.tree.map(lambda a: np.repeat(a, starts, axis=0), moving)
        self.members = len(problems[0])
        lanes = len(problems) * starts * self.members
        self.size = -(-lanes // -(-lanes // _LANES))

    def __call__(self, z: np.ndarray, runs: np.ndarray) -> Evaluation:
        points = np.repeat(z, self.members, axis=0)
        run = np.repeat(runs, self.members)
        member = np.tile(np.arange(self.members), len(runs))

        def evaluated(lanes: np.ndarray) -> Evaluation:
            there = run[lanes], member[lanes]
            moving = jax.tree.map(lambda a: a[there], self.moving)
            found = _evaluate(self.evaluate, points[lanes], moving, self.shared)
            return jax.tree.map(np.asarray, found)

        # Copies fill the last group.
        shape = -(-len(run) // self.size), self.size
        groups = map(evaluated, np.resize(np.arange(len(run)), shape))
        rows = jax.tree.map(lambda *a: np.concatenate(a)[: len(run)], *groups)
        shape = len(runs), self.members
        members = jax.tree.map(lambda a: a.reshape(*shape, *a.shape[1:]), rows)
        return power_mean(members, self.order)


def power_mean(members: Evaluation, order: int) -> Evaluation:
    """The power mean over the axis of members, mean(loss^order)^(1/order)."""
    loss, gradient, curvature, facts = members
    largest = np.max(loss, axis=1, keepdims=True)
    part = loss / np.where(largest > 0, largest, 1)
    mean = np.mean(part**order, axis=1, keepdims=True) ** (1 / order)
    # The weight (loss / mean)^(order - 1) / members; loss and mean vanish together.
    weight = (part / np.where(mean > 0, mean, 1)) ** (order - 1) / loss.shape[1]
    total = np.einsum("rm,rmn->rn", weight, gradient)
    bent = np.einsum("rm,rmij->rij", weight, curvature)
    whole = mean * largest
    if order > 1:
        value = np.where(loss > 0, loss, 1)
        spread = np.einsum("rm,rmi,rmj->rij", weight / value, gradient, gradient)
        outer = total[:, :, None] * total[:, None, :]
        spread -= outer / np.where(whole > 0, whole, 1)[:, :, None]
        bent = bent + (order - 1) * spread
    return Evaluation(whole[:, 0], total, bent, facts | {"member_loss": loss})
