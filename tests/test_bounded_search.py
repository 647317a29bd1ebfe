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
        low, high = (
            -unit * draw.uniform(0, 0.5, size),
            unit * draw.uniform(0, 0.5, size),
        )
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
                search.Evaluation(
                    np.sum(residual**2), 2 * jacobian.T @ residual,
                    2 * jacobian.T @ jacobian, {},
                )
            )  # fmt: skip
        return jax.tree.map(lambda *rows: np.stack(rows), *found)

    runs = search.minimise(
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
        return search.Evaluation(
            loss, 2 * z, np.broadcast_to(2 * np.eye(2), (len(z), 2, 2)), {}
        )

    box = np.ones((3, 2))
    runs = search.minimise(
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
        return search.Evaluation(loss, slopes, np.stack([np.eye(2)] * 2), {})

    corner, flat = search.minimise(
        evaluate, starts, np.zeros((2, 2)), np.ones((2, 2)),
        method="levenberg-marquardt", max_steps=3, enough=1e-4,
    )  # fmt: skip
    assert len(corner.rows) == len(flat.rows) == 1
    assert corner.converged and not corner.flat
    assert flat.flat and not flat.converged


def test_power_mean_has_the_derivatives_of_its_own_formula():
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(1, 4, 5, 3))  # residuals of four members, linear

    def members(z):
        jacobian = coefficients
        residual = jacobian @ z + np.arange(1, 6)
        return search.Evaluation(
            np.sum(residual**2, -1),
            2 * np.einsum("rmkn,rmk->rmn", jacobian, residual),
            2 * np.einsum("rmki,rmkj->rmij", jacobian, jacobian),
            {},
        )

    z, h = rng.normal(size=3), 1e-5
    for order in (1, 32):
        here = search.power_mean(members(z), order)
        loss = members(z).loss[0]
        assert here.loss[0] == pytest.approx(np.mean(loss**order) ** (1 / order))
        sides = [
            [search.power_mean(members(z + s * h * e), order) for s in (1, -1)]
            for e in np.eye(3)
        ]
        slopes = [(a.loss[0] - b.loss[0]) / (2 * h) for a, b in sides]
        np.testing.assert_allclose(here.gradient[0], slopes, rtol=1e-6)
        # For linear residuals the Gauss-Newton curvature is the second derivative.
        bends = [(a.gradient[0] - b.gradient[0]) / (2 * h) for a, b in sides]
        np.testing.assert_allclose(here.curvature[0], bends, rtol=1e-5, atol=1e-5)
    nothing = search.Evaluation(
        np.zeros((1, 2)), np.zeros((1, 2, 3)), np.zeros((1, 2, 3, 3)), {}
    )
    assert all(np.isfinite(a).all() for a in search.power_mean(nothing, 32)[:3])
