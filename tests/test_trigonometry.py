"""sin, cos and atan2 to 2 ulp, relative, compared with 50 digits and more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

from fdof_jax.base import trigonometry

# Compiled as a whole, which takes less time than one operation after another.
sincos, plane_angle = map(jax.jit, (trigonometry.sincos, trigonometry.plane_angle))
RANGES = {np.float64: 2.0**20, np.float32: 1500.0}


def arguments(dtype):
    """Returns a dense sweep, tiny angles, and numbers nearest to multiples of pi/2."""
    rng, largest = np.random.default_rng(0), RANGES[dtype]
    quadrants = rng.integers(1, int(largest * 2 / np.pi), 300)
    quadrants = np.concatenate([np.arange(1, 100), quadrants])
    zeros = np.array([float(mpf(int(n)) * mp.pi / 2) for n in quadrants]).astype(dtype)
    others = [np.linspace(0, 7, 501), rng.uniform(0, largest, 500)]
    others += [10.0 ** rng.uniform(-30, 0, 100)]
    beside = [np.nextafter(zeros, dtype(to)) for to in (0, 2 * largest)]
    x = np.concatenate([*others, zeros, *beside]).astype(dtype)
    x = x[x <= largest]
    return np.concatenate([x, -x])


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
@pytest.mark.parametrize("function, exact, drawn", [
    (lambda x: sincos(x)[0], mp.sin, arguments),
    (lambda x: sincos(x)[1], mp.cos, arguments),
    (plane_angle, mp.atan2, vectors),
], ids=["sin", "cos", "atan2"])  # fmt: skip
def test_two_ulp(function, exact, drawn, dtype):
    with mp.workprec(300):
        rows = np.atleast_2d(drawn(dtype))
        computed = np.asarray(function(*rows))
        assert computed.dtype == dtype
        for value, *x in zip(computed, *rows):
            truth = exact(*(mpf(float(xi)) for xi in x))
            # The ulp of 0 is denormal: flushed to 0 after some kernels.
            ulp = truth and float(np.spacing(abs(dtype(float(truth)))))
            assert abs(mpf(float(value)) - truth) <= 2 * ulp, x


def test_the_cut_and_beyond_the_range():
    """The argument is kept to one rounding; at the cut angles have the sign of y."""
    angles = plane_angle(jnp.array([0.0, -0.0, jnp.nan]), jnp.array([-1.0, -1.0, 1.0]))
    np.testing.assert_array_equal(angles, [np.pi, -np.pi, np.nan])
    assert np.isnan(np.asarray(sincos(jnp.array([jnp.inf, -jnp.inf, jnp.nan])))).all()
    x = np.random.default_rng(0).uniform(2.0**20, 2.0**40, 200)
    sin, cos = map(np.asarray, sincos(x))
    np.testing.assert_allclose(sin, np.sin(x), atol=np.spacing(x).max())
    np.testing.assert_allclose(sin**2 + cos**2, 1, atol=1e-15)


def test_derivatives_are_exact():
    x = np.linspace(-20.0, 20.0, 101)
    sin, cos = sincos(x)
    second = jax.jit(jax.vmap(jax.grad(jax.grad(lambda x: sincos(x)[1]))))(x)
    np.testing.assert_array_equal(second, -cos)
    forward = jax.jit(jax.vmap(jax.jacfwd(lambda x: jnp.stack(sincos(x)))))(x)
    np.testing.assert_array_equal(forward, np.stack([cos, -sin], axis=-1))


def test_derivatives_of_angles():
    """They are (-y, x) / (x^2 + y^2), and 0 at the origin, at any size."""
    y, x = vectors(np.float64)
    slopes = jax.jit(jax.vmap(jax.grad(plane_angle, (1, 0))))(y, x)
    square = x**2 + y**2
    exact = np.stack([-y, x]) / np.where(square == 0, 1, square)
    np.testing.assert_allclose(np.stack(slopes), exact, rtol=1e-15)
    tiny = jax.jit(jax.grad(plane_angle))(1e-200, 1e-200)  # whose square is 0
    assert tiny == pytest.approx(0.5e200, rel=1e-15)
    # -2 x y / (x^2 + y^2)^2
    twice = jax.jit(jax.grad(jax.grad(plane_angle)))(0.5, 1.0)
    assert twice == pytest.approx(-1 / 1.25**2, rel=1e-15)
