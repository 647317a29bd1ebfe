"""Iterations of methods for minimisation within bounds."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy


class Evaluation(NamedTuple):
    """A function and its derivatives at one point per run.

    - `loss` (run,); `gradient` (run, n); `curvature` (run, n, n): semidefinite, for
      instance Gauss-Newton.
    - `facts`: arrays (run, ...) kept with the point.
    """

    loss: Any
    gradient: Any
    curvature: Any
    facts: dict[str, Any]

    def row(self, index: int) -> "Evaluation":
        return jax.tree.map(lambda a: a[index], self)


class LevenbergMarquardt:
    """The Levenberg-Marquardt method: steps to its model's minimum in the box."""

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
        """Shortens the next step, and returns whether one is left to try."""
        self.damping *= self.growth
        self.growth *= 2
        return self.damping <= 1e8


class LBFGS:
    """optax's L-BFGS directions, projected into the box, shortened until descent."""

    def __init__(self, z: np.ndarray):
        import optax  # slow to import, and not needed by the default method

        self.optimiser = optax.scale_by_lbfgs()
        self.update = jax.jit(self.optimiser.update)
        self.state: Any = self.optimiser.init(jnp.asarray(z))
        self.direction: np.ndarray | None = None
        self.share = 1.0

    def step(self, z, here: Evaluation, low, high) -> np.ndarray:
        held = held_at_bounds(z, here.gradient, low, high)
        if self.direction is None:
            update, self.state = self.update(
                jnp.asarray(here.gradient), self.state, jnp.asarray(z)
            )
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


METHODS: dict[str, Any] = {"levenberg-marquardt": LevenbergMarquardt, "l-bfgs": LBFGS}


def box_minimum(
    matrix: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Minimises slope @ x + x @ matrix @ x / 2 in a box, for a definite matrix.

    Unknowns with equal bounds are 0.
    """
    result = np.zeros_like(slope)
    room = low < high
    if not room.any():
        return result
    # A unit diagonal makes the factorisation independent of the unknowns' sizes.
    scale = 1 / np.sqrt(np.diag(matrix)[room])
    normal = matrix[np.ix_(room, room)] * scale[:, None] * scale
    problem = normal, slope[room] * scale, low[room] / scale, high[room] / scale
    found = _by_sets(*problem)
    if found is None:
        found = _by_bvls(*problem)
    # Active bounds are met exactly, without rounding by the scaling.
    _, _, lowest, highest = problem
    inside = np.clip(found * scale, low[room], high[room])
    result[room] = np.where(
        found <= lowest, low[room], np.where(found >= highest, high[room], inside)
    )
    return result


def _by_sets(normal, slope, low, high) -> np.ndarray | None:
    """Minimises by updating guesses of the active bounds until one proves right.

    This takes few factorisations; BVLS takes one per bound. Returns None after 20
    guesses, as they may cycle.
    """
    below = above = np.zeros(slope.shape, bool)
    for _ in range(20):
        x = np.where(below, low, np.where(above, high, 0.0))
        free = ~(below | above)
        if free.any():
            factor = scipy.linalg.cho_factor(normal[np.ix_(free, free)])
            x[free] = scipy.linalg.cho_solve(factor, -(slope + normal @ x)[free])
        rise = slope + normal @ x
        sets = (x < low) | below & (rise > 0), (x > high) | above & (rise < 0)
        if (sets[0] == below).all() and (sets[1] == above).all():
            return x
        below, above = sets
    return None


def _by_bvls(normal, slope, low, high) -> np.ndarray:
    factor = scipy.linalg.cholesky(normal)
    target = -scipy.linalg.solve_triangular(factor, slope, trans=1)
    return scipy.optimize.lsq_linear(
        factor, target, (low, high), method="bvls", tol=1e-12
    ).x


def held_at_bounds(z, gradient, low, high) -> np.ndarray:
    return ((z <= low) & (gradient > 0)) | ((z >= high) & (gradient < 0))
