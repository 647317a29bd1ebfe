"""sin and cos to 2 ulp, relative, compared with 50 digits and more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf

from fdof_jax.base.trigonometry import sincos

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
