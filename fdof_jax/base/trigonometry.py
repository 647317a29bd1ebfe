"""Sine, cosine and angles that XLA vectorises on CPU.

Polynomials fuse into loops, unlike calls of the scalar C library.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .one_loop import one_loop_on_cpu

# pi/2 as three parts with trailing zeros, whose products with a quadrant number
# below 2**20 (float64) or 2**10 (float32) are exact, and a remainder.
_HALF_PI = {
    np.dtype("float64"): (
        1.5707963267341256,
        6.077100506303966e-11,
        2.0222662487111665e-21,
        8.4784276603689e-32,
    ),
    np.dtype("float32"): (
        1.5706787109375,
        0.00011761486530303955,
        9.920313459588215e-10,
        6.223372171896613e-14,
    ),
}
# Chebyshev fits, highest power of z = r**2 first, of (sin(r)/r - 1)/z and
# (cos(r) - 1 + z/2)/z**2 on |r| <= pi/4: error below 0.2 ulp of the result.
_SIN = {
    np.dtype("float64"): (
        1.5918129027234826e-10,
        -2.505113184128889e-08,
        2.7557316102534617e-06,
        -0.0001984126983675854,
        0.008333333333330948,
        -0.16666666666666666,
    ),
    np.dtype("float32"): (
        -0.000195878904001737,
        0.008332748268406942,
        -0.1666666466230294,
    ),
}
_COS = {
    np.dtype("float64"): (
        -1.1382632258093615e-11,
        2.087614626607931e-09,
        -2.7557317271718644e-07,
        2.4801587298765665e-05,
        -0.0013888888888887398,
        0.041666666666666664,
    ),
    np.dtype("float32"): (
        2.4547941603820702e-05,
        -0.0013888303033667549,
        0.041666664659490746,
    ),
}
# The same of (atan(r)/r - 1)/z on |r| <= tan(pi/8).
_ATAN = {
    np.dtype("float64"): (
        -0.019176885636589053,
        0.039231657085083686,
        -0.050854496960392584,
        0.05858148904795124,
        -0.0666451144646022,
        0.07692183190760651,
        -0.09090904578121085,
        0.11111111015256292,
        -0.14285714284666542,
        0.1999999999999552,
        -0.3333333333333333,
    ),
    np.dtype("float32"): (
        -0.06451927998778499,
        0.10743731427626937,
        -0.14263955592140723,
        0.19999540483480294,
        -0.33333331761167784,
    ),
}
# Adding 1.5 * 2**(mantissa bits) to a whole number leaves it in the low bits, which
# is cheaper than a conversion to integer with its checks for overflow.
_INTEGER_BITS = {
    np.dtype("float64"): (6755399441055744.0, np.int64, 62),
    np.dtype("float32"): (12582912.0, np.int32, 30),
}


def _horner(coefficients: tuple[float, ...], z: Array) -> Array:
    value = jnp.full_like(z, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * z + coefficient
    return value


def _polynomial_sincos(x: Array) -> tuple[Array, Array]:
    shift, integer, sign_shift = _INTEGER_BITS[x.dtype]
    part1, part2, part3, tail = _HALF_PI[x.dtype]
    quadrants = jax.lax.round(x * (2 / np.pi), jax.lax.RoundingMethod.TO_NEAREST_EVEN)
    # The first three products are exact. Near a zero of the result the differences
    # are exact too; elsewhere their rounding errors are kept (Dekker).
    high = x - quadrants * part1
    middle, low = quadrants * part2, quadrants * part3
    difference = high - middle
    r = difference - low
    error = ((high - difference) - middle) + ((difference - r) - low)
    r = r + (error - quadrants * tail)
    z = r * r
    sin_r = r + r * (z * _horner(_SIN[x.dtype], z))
    cos_r = (1 - 0.5 * z) + z * (z * _horner(_COS[x.dtype], z))
    quadrant = jax.lax.bitcast_convert_type(quadrants + shift, integer)
    swap = (quadrant & 1) == 1
    sin = jnp.where(swap, cos_r, sin_r)
    cos = jnp.where(swap, sin_r, cos_r)

    def with_sign(value: Array, bit: Array) -> Array:
        bits = jax.lax.bitcast_convert_type(value, integer)
        return jax.lax.bitcast_convert_type(bits ^ (bit << sign_shift), value.dtype)

    # Quadrants 2 and 3 flip the sine, 1 and 2 the cosine.
    return with_sign(sin, quadrant & 2), with_sign(cos, (quadrant + 1) & 2)


def _with_derivatives(on_cpu: Callable) -> Callable:
    """Returns a function for the sine and cosine, which `on_cpu` computes on CPU."""

    @jax.custom_jvp
    def both(x: Array) -> tuple[Array, Array]:
        return jax.lax.platform_dependent(
            x, cpu=on_cpu, default=lambda x: (jnp.sin(x), jnp.cos(x))
        )

    @both.defjvp
    def rule(primals, tangents):
        (x,), (x_dot,) = primals, tangents
        sin, cos = both(x)
        return (sin, cos), (cos * x_dot, -sin * x_dot)

    return both


# XLA would compute the polynomials anew in each loop that uses them: ten times for a
# circle's inverse kinematics.
_once = _with_derivatives(lambda x: one_loop_on_cpu(_polynomial_sincos(x)))
_inlined = _with_derivatives(_polynomial_sincos)


def sincos(
    x: ArrayLike, inlined: bool = False
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Computes the sine and cosine of `x` [rad], each to 2 ulp, also near their zeros.

    This holds for |x| <= 2**20 in float64 and |x| <= 1500 in float32. Beyond, the
    result is that of an angle within one rounding of `x`.

    **Arguments:** `inlined`: whether they become a part of the loop that uses them, if
    that is one loop already; by default they have a loop of their own.
    """
    return (_inlined if inlined else _once)(
        jnp.asarray(x, dtype=jnp.result_type(float, x))
    )


def _polynomial_angle(y: Array, x: Array) -> Array:
    longer, shorter = jnp.maximum(abs(x), abs(y)), jnp.minimum(abs(x), abs(y))
    # Beyond a sixteenth of a turn, the angle is counted from an eighth of a turn.
    beyond = shorter > np.tan(np.pi / 8) * longer
    over = jnp.where(beyond, longer + shorter, longer)
    r = jnp.where(beyond, shorter - longer, shorter) / jnp.where(over == 0, 1, over)
    z = r * r
    angle = r + r * (z * _horner(_ATAN[x.dtype], z))
    angle = jnp.where(beyond, np.pi / 4 + angle, angle)
    angle = jnp.where(abs(y) > abs(x), np.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, np.pi - angle, angle)
    return jnp.where(jnp.signbit(y), -angle, angle)


@jax.custom_jvp
def plane_angle(y: Array, x: Array) -> Array:
    """Computes atan2 to 2 ulp, with derivative zero instead of NaN at the origin."""
    finite = lambda y, x: jnp.arctan2(y, jnp.where((x == 0) & (y == 0), 1, x))
    return jax.lax.platform_dependent(y, x, cpu=_polynomial_angle, default=finite)


@plane_angle.defjvp
def _plane_angle_jvp(primals, tangents):
    (y, x), (y_dot, x_dot) = primals, tangents
    # Of vectors of any size, whose squares may underflow.
    size = jnp.maximum(abs(x), abs(y))
    size = jnp.where(size == 0, 1, size)
    across, along = y / size, x / size
    square = across**2 + along**2
    rate = (along * y_dot - across * x_dot) / (size * jnp.where(square == 0, 1, square))
    return plane_angle(y, x), rate
