"""Minimisation within bounds, compared with SciPy on several functions."""

import jax
import numpy as np
import pytest
import scipy.optimize

from fdof_jax.search import bounded, methods


def test_box_minimum_is_that_of_scipy():
    rng = np.random.default_rng(1)
    for _ in range(20):
        jacobian = rng.normal(size=(20, 3)) * [1, 1e4, 1e-3]
        matrix, slope = jacobian.T @ jacobian, jacobian.T @ rng.normal(size=20)
        scale = 1 / np.sqrt(np.diag(matrix))
        low, high = -rng.uniform(0, 0.3, 3) * scale, rng.uniform(0, 0.3, 3) * scale
        low[2] = high[2] = 0 if rng.uniform() < 0.3 else high[2]
        low[2] = min(low[2], 0)

        def model(u, slope=slope, scale=scale, matrix=matrix):
            return slope @ (scale * u) + u * scale @ matrix @ (scale * u) / 2

        found = methods.box_minimum(matrix, slope, low, high)
        assert (found >= low).all() and (found <= high).all()
        bounds = list(zip(low / scale, high / scale))
        best = scipy.optimize.minimize(model, np.zeros(3), bounds=bounds, tol=1e-14)
        assert model(found / scale) <= best.fun + 1e-9 * abs(best.fun)


@pytest.mark.parametrize("method", methods.METHODS)
def test_minimise_finds_what_scipy_finds_within_bounds(method):
    """Minimises Rosenbrock's function and an exponential fit in boxes that cut them."""
    t = np.linspace(0, 1, 12)
    data = 2 * np.exp(-1.5 * t) + 0.05 * np.cos(40 * t)
    problems = [
        (
            lambda z: np.array([1 - z[0], 10 * (z[1] - z[0] ** 2)]),
            lambda z: np.array([[-1, 0], [-20 * z[0], 10.0]]),
        ),
        (
            lambda z: z[0] * np.exp(-z[1] * t) - data,
            lambda z: (
                np.exp(-z[1] * t)[:, None]
                * np.stack([np.ones_like(t), -z[0] * t], axis=1)
            ),
        ),
    ]
    starts = np.array([[-1.2, 1.0], [0.5, 0.5]] * 2)
    low = np.array([[-2.0, -2.0], [0.1, 0.1], [-2.0, -2.0], [0.1, 0.1]])
    high = np.array([[0.7, 2.0], [1.9, 5.0], [2.0, 2.0], [5.0, 5.0]])

    def evaluate(z, runs):
        found = []
        for point, run in zip(z, runs):
            residual, jacobian = (f(point) for f in problems[run % 2])
            found.append(
                methods.Evaluation(
                    np.sum(residual**2), 2 * jacobian.T @ residual,
                    2 * jacobian.T @ jacobian, {},
                )
            )  # fmt: skip
        return jax.tree.map(lambda *rows: np.stack(rows), *found)

    runs = bounded.minimise(
        evaluate, starts, low, high, method=method, max_steps=200, enough=1e-12
    )
    for i, run in enumerate(runs):
        residual, jacobian = problems[i % 2]
        best = scipy.optimize.least_squares(
            residual, starts[i], jacobian, bounds=(low[i], high[i]), xtol=1e-14,
            ftol=1e-14, gtol=1e-14,
        )  # fmt: skip
        assert run.best.loss <= 2 * best.cost * (1 + 1e-6) + 1e-9, (i, run.reason)
        assert ((run.best.z >= low[i]) & (run.best.z <= high[i])).all()


def test_one_failing_start_does_not_spoil_the_others():
    def evaluate(z, runs):
        loss = np.where(runs == 1, np.nan, np.sum(z**2, axis=1))
        return methods.Evaluation(
            loss, 2 * z, np.broadcast_to(2 * np.eye(2), (len(z), 2, 2)), {}
        )

    box = np.ones((3, 2))
    runs = bounded.minimise(
        evaluate, box.copy(), -9 * box, 9 * box, method="levenberg-marquardt",
        max_steps=20, enough=1e-6,
    )  # fmt: skip
    assert [run.failed for run in runs] == [False, True, False]
    assert runs[0].converged and not runs[1].converged and runs[2].best.loss < 1e-10


def test_a_start_held_by_all_bounds_has_converged_and_a_flat_one_has_not():
    starts = np.array([[1.0, 1.0], [0.0, 0.0]])

    def evaluate(z, runs):
        # Downwards beyond both bounds; flat in the second run.
        slopes = np.where(runs[:, None] == 0, -1.0, 0.0) * np.ones(2)
        loss = 5 + np.sum(slopes * z, axis=1)
        return methods.Evaluation(loss, slopes, np.stack([np.eye(2)] * 2), {})

    corner, flat = bounded.minimise(
        evaluate, starts, np.zeros((2, 2)), np.ones((2, 2)),
        method="levenberg-marquardt", max_steps=3, enough=1e-4,
    )  # fmt: skip
    assert len(corner.rows) == len(flat.rows) == 1
    assert corner.converged and not corner.flat
    assert flat.flat and not flat.converged
