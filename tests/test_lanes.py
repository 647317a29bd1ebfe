"""The mean over an ensemble, and its derivatives."""

import numpy as np
import pytest

from fdof_jax.search import lanes, methods


def test_power_mean_has_the_derivatives_of_its_own_formula():
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(1, 4, 5, 3))  # residuals of four members, linear

    def members(z):
        jacobian = coefficients
        residual = jacobian @ z + np.arange(1, 6)
        return methods.Evaluation(
            np.sum(residual**2, -1),
            2 * np.einsum("rmkn,rmk->rmn", jacobian, residual),
            2 * np.einsum("rmki,rmkj->rmij", jacobian, jacobian),
            {},
        )

    z, h = rng.normal(size=3), 1e-5
    for order in (1, 32):
        here = lanes.power_mean(members(z), order)
        loss = members(z).loss[0]
        assert here.loss[0] == pytest.approx(np.mean(loss**order) ** (1 / order))
        sides = [
            [lanes.power_mean(members(z + s * h * e), order) for s in (1, -1)]
            for e in np.eye(3)
        ]
        slopes = [(a.loss[0] - b.loss[0]) / (2 * h) for a, b in sides]
        np.testing.assert_allclose(here.gradient[0], slopes, rtol=1e-6)
        # For linear residuals the Gauss-Newton curvature is the second derivative.
        bends = [(a.gradient[0] - b.gradient[0]) / (2 * h) for a, b in sides]
        np.testing.assert_allclose(here.curvature[0], bends, rtol=1e-5, atol=1e-5)
    nothing = methods.Evaluation(
        np.zeros((1, 2)), np.zeros((1, 2, 3)), np.zeros((1, 2, 3, 3)), {}
    )
    assert all(np.isfinite(a).all() for a in lanes.power_mean(nothing, 32)[:3])
