"""Minimisation within bounds, of several functions and of means over members."""

import jax
import numpy as np
import pytest
import scipy.optimize

from fdof_jax.tuning import search


def test_steps_within_a_box_are_the_least():
    """At a minimum there is no slope inside, and at bounds none into the box.

    Where searches start from bounds, guesses of the active ones may cycle.
    """
    for seed in range(300):
        draw = np.random.default_rng(seed)
        size = 200 if seed < 3 else 6
        root = draw.normal(size=(size + 1, size)) + 3 * draw.normal(size=(size + 1, 1))
        root *= draw.uniform(1e-3, 1e3, size)
        matrix, slope = root.T @ root, root.T @ draw.normal(size=size + 1)
        matrix += 10.0 ** draw.uniform(-6, 0) * np.diag(np.diag(matrix))
        unit = 1 / np.sqrt(np.diag(matrix))
        low, high = unit * draw.uniform(0, 0.5, (2, size)) * [[-1], [1]]
        where = draw.uniform(size=size)
        low[where < 0.4] = high[where > 0.7] = 0
        high[0] = low[0]  # without room
        x = search.box_minimum(matrix, slope, low, high)
        assert x[0] == low[0] and ((low <= x) & (x <= high)).all()
        rise = (unit * (slope + matrix @ x))[1:] / np.abs(unit * slope).max()
        assert (rise[x[1:] > low[1:]] < 1e-9).all()
        assert (rise[x[1:] < high[1:]] > -1e-9).all()


@pytest.mark.parametrize("method", search.METHODS)
def test_minimise_finds_what_scipy_finds_within_bounds(method):
    """Minimises Rosenbrock's function and an exponential fit in boxes that cut them."""
    t = np.linspace(0, 1, 12)
    data = 2 * np.exp(-1.5 * t) + 0.05 * np.cos(40 * t)
    decay = lambda z: np.exp(-z[1] * t)
    problems = [
        (
            lambda z: np.array([1 - z[0], 10 * (z[1] - z[0] ** 2)]),
            lambda z: np.array([[-1, 0], [-20 * z[0], 10.0]]),
        ),
        (
            lambda z: z[0] * decay(z) - data,
            lambda z: decay(z)[:, None] * np.stack([t**0, -z[0] * t], axis=1),
        ),
    ]
    starts = np.array([[-1.2, 1.0], [0.5, 0.5]] * 2)
    low = np.array([[-2.0, -2.0], [0.1, 0.1], [-2.0, -2.0], [0.1, 0.1]])
    high = np.array([[0.7, 2.0], [1.9, 5.0], [2.0, 2.0], [5.0, 5.0]])

    def evaluate(z, runs):
        found = []
        for point, run in zip(z, runs):
            r, slopes = (f(point) for f in problems[run % 2])
            derivatives = 2 * slopes.T @ r, 2 * slopes.T @ slopes
            found.append(search.Evaluation(np.sum(r**2), *derivatives, {}))
        return jax.tree.map(lambda *rows: np.stack(rows), *found)

    options = dict(method=method, max_steps=200, enough=1e-12)
    runs = search.minimise(evaluate, starts, low, high, **options)
    exact = dict(xtol=1e-14, ftol=1e-14, gtol=1e-14)
    for i, run in enumerate(runs):
        box = low[i], high[i]
        best = scipy.optimize.least_squares(
            problems[i % 2][0], starts[i], problems[i % 2][1], bounds=box, **exact
        )
        assert run.best.loss <= 2 * best.cost * (1 + 1e-6) + 1e-9, (i, run.reason)
        assert ((run.best.z >= low[i]) & (run.best.z <= high[i])).all()


def test_runs_that_fail_that_bounds_hold_and_that_are_flat_end_beside_another():
    def evaluate(z, runs):
        slope = np.array([0.0, 0.0, -1.0, 0.0])[runs, None] * np.ones(2)
        bent = np.array([2.0, np.nan, 0.0, 0.0])[runs, None]
        loss = 5 + np.sum(slope * z + bent * z**2 / 2, axis=1)
        matrices = np.stack([2 * np.eye(2)] * len(z))
        return search.Evaluation(loss, slope + bent * z, matrices, {})

    starts = np.ones((4, 2))
    runs = search.minimise(
        evaluate, starts, -9 * starts, starts, method="levenberg-marquardt",
        max_steps=20, enough=1e-6,
    )  # fmt: skip
    whole, failed, held, flat = runs
    assert [run.failed for run in runs] == [False, True, False, False]
    assert whole.converged and whole.best.loss == pytest.approx(5, abs=1e-10)
    assert not failed.converged
    assert held.converged and not held.flat and len(held.rows) == 1
    assert flat.flat and not flat.converged
