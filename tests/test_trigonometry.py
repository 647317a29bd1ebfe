"""sin, cos and atan2 to 2 ulp, relative, compared with 50 digits and more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

from fdof_jax.base.trigonometry import plane_angle, sincos

RANGES = {np.float64: 2.0**20, np.float32: 1500.0}


def arguments(dtype, rng):
    """Returns a dense sweep, tiny angles, and numbers nearest to multiples of pi/2."""
    largest = RANGES[dtype]
    quadrants = np.unique(rng.integers(1, int(largest * 2 / np.pi), 1500))
    quadrants = np.concatenate([np.arange(1, 500), quadrants])
    zeros = np.array([float(mpf(int(n)) * mp.pi / 2) for n in quadrants]).astype(dtype)
    positive = np.concatenate(
        [
            np.linspace(0, 7, 5001)[1:],
            rng.uniform(0, largest, 5000),
            10.0 ** rng.uniform(-30, 0, 500),
            zeros,
            np.nextafter(zeros, dtype(0)),
            np.nextafter(zeros, dtype(largest * 2)),
        ]
    ).astype(dtype)
    positive = positive[positive <= largest]
    return np.concatenate([positive, -positive, np.zeros(1, dtype)])


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_two_ulp(dtype):
    with mp.workprec(300):
        x = arguments(dtype, np.random.default_rng(0))
        computed = jax.jit(sincos)(jnp.asarray(x))
        for values, exact in zip(computed, (mp.sin, mp.cos)):
            assert values.dtype == dtype
            for xi, value in zip(x, np.asarray(values)):
                truth = exact(mpf(float(xi)))
                # The ulp of 0 is denormal: flushed to 0 after some kernels.
                ulp = truth and float(np.spacing(abs(dtype(float(truth)))))
                assert abs(mpf(float(value)) - truth) <= 2 * ulp, xi


def test_beyond_the_range_the_argument_is_kept_to_one_rounding():
    assert np.isnan(np.asarray(sincos(jnp.array([jnp.inf, -jnp.inf, jnp.nan])))).all()
    x = np.random.default_rng(0).uniform(2.0**20, 2.0**40, 200)
    sin, cos = map(np.asarray, sincos(x))
    np.testing.assert_allclose(sin, np.sin(x), atol=np.spacing(x).max())
    np.testing.assert_allclose(sin**2 + cos**2, 1, atol=1e-15)


def test_derivatives_are_exact():
    x = np.linspace(-20.0, 20.0, 101)
    sin, cos = sincos(x)
    first = jax.vmap(jax.grad(lambda x: sincos(x)[0]))(x)
    np.testing.assert_array_equal(first, cos)
    second = jax.vmap(jax.grad(jax.grad(lambda x: sincos(x)[1])))(x)
    np.testing.assert_array_equal(second, -cos)
    forward = jax.vmap(jax.jacfwd(lambda x: jnp.stack(sincos(x))))(x)
    np.testing.assert_array_equal(forward, np.stack([cos, -sin], axis=-1))


def vectors(dtype):
    """Returns vectors all around, near the axes and diagonals, and of other sizes."""
    rng = np.random.default_rng(0)
    angle = np.concatenate([rng.uniform(-np.pi, np.pi, 300), np.pi / 8 * np.arange(16)])
    near = (angle[300:, None] + 10.0 ** rng.uniform(-12, -1, (16, 5))).ravel()
    angle = np.append(angle, near)
    size = 10.0 ** rng.uniform(-20, 15, angle.shape)
    axes = np.array([[0, 1], [1, 0], [0, -1], [-1, 0], [1, 1], [-1, 1], [0, 0]])
    rows = np.stack([size * np.sin(angle), size * np.cos(angle)], axis=1)
    return np.concatenate([rows, axes]).astype(dtype).T


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_angles_to_two_ulp(dtype):
    y, x = vectors(dtype)
    computed = np.asarray(jax.jit(plane_angle)(jnp.asarray(y), jnp.asarray(x)))
    assert computed.dtype == dtype
    with mp.workprec(200):
        for value, *vector in zip(computed, y, x):
            truth = mp.atan2(*map(mpf, map(float, vector)))
            ulp = float(np.spacing(abs(dtype(float(truth)))))
            assert abs(mpf(float(value)) - truth) <= 2 * ulp, vector


def test_angles_at_the_cut_have_the_sign_of_y():
    angles = plane_angle(jnp.array([0.0, -0.0]), jnp.array([-1.0, -1.0]))
    assert angles.tolist() == [np.pi, -np.pi]
    assert np.isnan(plane_angle(jnp.array(jnp.nan), jnp.array(1.0)))


def test_derivatives_of_angles():
    """They are (-y, x) / (x^2 + y^2), and 0 at the origin, at any size."""
    y, x = vectors(np.float64)
    along, across = (jax.vmap(jax.grad(plane_angle, k))(y, x) for k in (1, 0))
    square = x**2 + y**2
    exact = np.stack([-y, x]) / np.where(square == 0, 1, square)
    np.testing.assert_allclose(np.stack([along, across]), exact, rtol=1e-15)
    tiny = jax.grad(plane_angle)(1e-200, 1e-200)  # whose square is 0
    assert tiny == pytest.approx(0.5e200, rel=1e-15)
    twice = jax.grad(jax.grad(plane_angle))(0.5, 1.0)  # -2 x y / (x^2 + y^2)^2
    assert twice == pytest.approx(-1 / 1.25**2, rel=1e-15)
