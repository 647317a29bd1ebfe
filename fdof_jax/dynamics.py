"""Equations of motion: the reduced 3x3 form and inverse dynamics in joint coordinates.

`rates` is what simulations integrate. It works on scalars, never on
stacked arrays: XLA on CPU computes a stacked result once per entry. Its positions are
displacements from a reference configuration, whose directions are turned by them:
a pendulum 1e-17 rad away from upright keeps that angle, which upright + 1e-17 would
not, and an arm that starts after a million turns moves as it would have before. The
algebra is a
composite-body recursion from the tip, S(EF)^T M S(EF) of the paper's six equations
without ever forming them; existence factors select, per joint, between turning about
a point and sliding along a direction.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from .kinematics import mass_center_velocities, mass_centers
from .linkage import Linkage, compiled, real_joints, to_chain
from .trigonometry import sincos

Scalars = tuple[Array, Array, Array]
Vector = tuple[Array, Array]


class Constants(NamedTuple):
    """What the equations need of a linkage, as scalars computed once per solve.

    `e_n` and `b_n` are the directions of the links and the slides at the reference
    configuration; `m34` = m3 + m4 and so on; `(s_n, t_n)` the first moment of link n,
    with the mass beyond it hung at the end of its vector A_n, along and across the link
    [kg m]; `j_n` second moments about the start of link n [kg m^2].
    """

    revolute: Scalars
    e1: Vector
    e2: Vector
    e3: Vector
    e4: Vector
    b2: Array
    b3: Array
    gravity: Array
    m4: Array
    m34: Array
    m234: Array
    a2: Array
    a3: Array
    s2: Array
    t2: Array
    s3: Array
    t3: Array
    s4: Array
    t4: Array
    j2: Array
    j3: Array
    j4: Array


def link_constants(linkage: Linkage, q: Float[Array, " joint"]) -> Constants:
    """The scalars that `rates` needs, with `q` as reference."""
    x, _ = to_chain(linkage, q, jnp.zeros_like(q))
    sin, cos = sincos(jnp.concatenate([linkage.base_angle[None], x[1::2]]))
    e1, e2, e3, e4 = zip(cos, sin)
    m2, m3, m4 = linkage.mass
    _, a2, a3, _ = linkage.length
    (s2, t2), (s3, t3), (s4, t4) = linkage.mass[:, None] * linkage.com
    j2, j3, j4 = linkage.inertia + linkage.mass * jnp.sum(linkage.com**2, axis=1)
    m34 = m3 + m4
    return Constants(
        revolute=real_joints(linkage.ef),
        e1=e1, e2=e2, e3=e3, e4=e4,
        b2=x[2], b3=x[4],
        gravity=linkage.gravity,
        m4=m4, m34=m34, m234=m2 + m34,
        a2=a2, a3=a3,
        s2=s2 + m34 * a2, t2=t2, s3=s3 + m4 * a3, t3=t3, s4=s4, t4=t4,
        j2=j2 + m34 * a2**2, j3=j3 + m4 * a3**2, j4=j4,
    )  # fmt: skip


def _cross(u: Vector, v: Vector) -> Array:
    return u[0] * v[1] - u[1] * v[0]


def _dot(u: Vector, v: Vector) -> Array:
    return u[0] * v[0] + u[1] * v[1]


def _add(u: Vector, v: Vector) -> Vector:
    return u[0] + v[0], u[1] + v[1]


def _perp(u: Vector) -> Vector:
    return -u[1], u[0]


def _in_frame(along: Array, across: Array, e: Vector) -> Vector:
    return along * e[0] - across * e[1], along * e[1] + across * e[0]


def _turn(e: Vector, angle: Array) -> Vector:
    sin, cos = sincos(angle)
    return _in_frame(cos, sin, e)


def _select(condition: Array, u: Vector, v: Vector) -> Vector:
    return jnp.where(condition, u[0], v[0]), jnp.where(condition, u[1], v[1])


class _Equations(NamedTuple):
    """M qdd + bias = tau, with M symmetric (kg m^2, kg m or kg by joint types)."""

    m11: Array
    m12: Array
    m13: Array
    m22: Array
    m23: Array
    m33: Array
    bias: Scalars


def _equations(c: Constants, delta: Scalars, qd: Scalars) -> _Equations:
    """The reduced equations of motion: (8)-(13) projected on the real joints."""
    r1, r2, r3 = c.revolute
    turned2 = jnp.where(r1, delta[0], 0)
    turned3 = turned2 + jnp.where(r2, delta[1], 0)
    turned4 = turned3 + jnp.where(r3, delta[2], 0)
    b2 = c.b2 + jnp.where(r2, 0, delta[1])
    b3 = c.b3 + jnp.where(r3, 0, delta[2])
    w2 = jnp.where(r1, qd[0], 0)
    turn3 = jnp.where(r2, qd[1], 0)
    turn4 = jnp.where(r3, qd[2], 0)
    w3 = w2 + turn3
    w4 = w3 + turn4

    n1 = _perp(c.e1)
    e2, e3, e4 = _turn(c.e2, turned2), _turn(c.e3, turned3), _turn(c.e4, turned4)
    n2, n3 = _perp(e2), _perp(e3)
    d2 = _in_frame(c.a2, b2, e2)
    d3 = _in_frame(c.a3, b3, e3)
    # First moments of the single links (u_n) and of everything beyond a joint (c_n).
    u4 = _in_frame(c.s4, c.t4, e4)
    u3 = _in_frame(c.s3, c.t3 + c.m4 * b3, e3)
    u2 = _in_frame(c.s2, c.t2 + c.m34 * b2, e2)
    c3 = _add(u3, u4)
    c2 = _add(u2, c3)
    # Second moments of everything beyond a joint, about that joint.
    k3 = c.j3 + c.m4 * b3 * b3 + 2 * _dot(d3, u4) + c.j4
    k2 = c.j2 + c.m34 * b2 * b2 + 2 * _dot(d2, c3) + k3

    # Momentum (linear, and angular about the joint) of what lies beyond a joint that
    # moves at unit rate; each joint before it feels its share.
    p3 = _select(r3, _perp(u4), (c.m4 * n3[0], c.m4 * n3[1]))
    p2 = _select(r2, _perp(c3), (c.m34 * n2[0], c.m34 * n2[1]))
    h3 = jnp.where(r3, c.j4, _cross(u4, n3))
    h2 = jnp.where(r2, k3, _cross(c3, n2))
    h3_at_2 = h3 + _cross(d3, p3)

    # Efforts that keep all joints at constant rate, gravity included. Differences of
    # squared angular velocities are products with the joint rates: absolute rates
    # may be large and close.
    slide2 = 2 * w2 * jnp.where(r2, 0, qd[1])
    slide3 = 2 * w3 * jnp.where(r3, 0, qd[2])
    w22, w33, w44 = w2 * w2, w3 * w3, w4 * w4
    cross34 = _cross(d3, u4)
    cross24 = _cross(d2, u4)
    coriolis3 = c.m4 * slide3
    y = (
        w33 * u3[0] + coriolis3 * e3[0] + w44 * u4[0],
        w33 * u3[1] + coriolis3 * e3[1] + w44 * u4[1],
    )
    # Moments about the joint (revolute), forces along the slide (prismatic).
    relative3 = slide3 * (c.m4 * b3 - _cross(u4, e3)) - turn4 * (w3 + w4) * cross34
    moment4 = (
        u4[0] * c.gravity
        + w22 * cross24
        + w33 * cross34
        - slide2 * _cross(u4, e2)
        - slide3 * _cross(u4, e3)
    )
    moment3 = (
        c3[0] * c.gravity + w22 * _cross(d2, c3) - slide2 * _cross(c3, e2) + relative3
    )
    moment2 = (
        c2[0] * c.gravity
        + relative3
        - turn3 * (w2 + w3) * _cross(d2, u3)
        - (turn3 + turn4) * (w2 + w4) * cross24
        + slide2 * (c.m34 * b2 - _cross(c3, e2))
        - coriolis3 * _cross(d2, e3)
    )
    start4 = c.gravity * e3[0] - w22 * _dot(n3, d2) - slide2 * _dot(n3, e2)
    force3 = c.m4 * (start4 - w33 * b3) - w44 * _dot(n3, u4)
    force2 = c.m34 * (c.gravity * e2[0] - w22 * b2) - _dot(n2, y)
    force1 = (
        c.m234 * c.gravity * c.e1[0]
        - w22 * _dot(n1, u2)
        - c.m34 * slide2 * _dot(n1, e2)
        - _dot(n1, y)
    )
    return _Equations(
        m11=jnp.where(r1, k2, c.m234),
        m12=jnp.where(r1, h2 + _cross(d2, p2), _dot(n1, p2)),
        m13=jnp.where(r1, h3_at_2 + _cross(d2, p3), _dot(n1, p3)),
        m22=jnp.where(r2, k3, c.m34),
        m23=jnp.where(r2, h3_at_2, _dot(n2, p3)),
        m33=jnp.where(r3, c.j4, c.m4),
        bias=(
            jnp.where(r1, moment2, force1),
            jnp.where(r2, moment3, force2),
            jnp.where(r3, moment4, force3),
        ),
    )


def zeros(q: Float[Array, " joint"]) -> Scalars:
    """Zero displacements, rates or efforts, in the dtype of `q`."""
    zero = jnp.zeros_like(q[0])
    return zero, zero, zero


# Compiled on its own so that it is traced once, not at each of a solve's uses of it.
@partial(jax.jit, static_argnames="reciprocal")
def _accelerations(
    c: Constants,
    delta: Scalars,
    qd: Scalars,
    tau: Scalars,
    reciprocal: Callable[[Array], Array] = lambda x: 1 / x,
) -> Scalars:
    m = _equations(c, delta, qd)
    f1, f2, f3 = (t - b for t, b in zip(tau, m.bias))
    # L^T D L from the tip: the pivots are the articulated inertias.
    inverse3 = reciprocal(m.m33)
    l23, l13 = m.m23 * inverse3, m.m13 * inverse3
    inverse2 = reciprocal(m.m22 - l23 * m.m23)
    rest12 = m.m12 - l13 * m.m23
    l12 = rest12 * inverse2
    inverse1 = reciprocal(m.m11 - l13 * m.m13 - l12 * rest12)
    y2 = f2 - l23 * f3
    qdd1 = (f1 - l13 * f3 - l12 * y2) * inverse1
    qdd2 = y2 * inverse2 - l12 * qdd1
    return qdd1, qdd2, f3 * inverse3 - l13 * qdd1 - l23 * qdd2


# A first guess of 1/x, good to 12 %: these bits less those of x.
_RECIPROCAL_BITS = {
    np.dtype("float64"): (np.int64(0x7FDE623822FC16E6), 5),
    np.dtype("float32"): (np.int32(0x7EF311C3), 4),
}


def _newton_reciprocal(x: Array) -> Array:
    """1/x to an ulp or two, without a division, which XLA keeps out of fused loops."""
    bits, iterations = _RECIPROCAL_BITS[x.dtype]
    guess = bits - jax.lax.bitcast_convert_type(x, bits.dtype)
    y = jax.lax.bitcast_convert_type(guess, x.dtype)
    for _ in range(iterations):
        y = y + y * (1 - x * y)
    return y


def _rates(
    c: Constants, delta: Scalars, qd: Scalars, tau: Scalars
) -> tuple[Scalars, Scalars]:
    return qd, _accelerations(c, delta, qd, tau)


def _rates_in_one_loop(
    c: Constants, delta: Scalars, qd: Scalars, tau: Scalars
) -> tuple[Scalars, Scalars]:
    """`_rates` as one loop over a batch, with six results.

    XLA on CPU gives each result of an expression, and each division in it, a loop of
    its own that computes everything anew: five evaluations of the equations for one.
    A reduction is the one operation with several results. This one takes the maximum
    of each result and itself, and a fused loop comes of it: 3 times faster in a batch
    of 1024, 11 times for a single arm (one core, jax 0.10.2). The velocities pass
    through it because XLA would otherwise copy the buffers of a Runge-Kutta method's
    stages, a quarter of a step's time.
    """
    results = (*qd, *_accelerations(c, delta, qd, tau, _newton_reciprocal))
    lowest = tuple(jnp.full((), -jnp.inf, r.dtype) for r in results)
    reduced = jax.lax.reduce(
        tuple(jnp.broadcast_to(r, (2,)) for r in results),
        lowest,
        lambda a, b: tuple(map(jax.lax.max, a, b)),
        dimensions=(0,),
    )
    return tuple(reduced[:3]), tuple(reduced[3:])


@jax.custom_jvp
def rates(
    c: Constants, delta: Scalars, qd: Scalars, tau: Scalars
) -> tuple[Scalars, Scalars]:
    """Rates of the joint displacements `delta` from the reference of `c`, and of `qd`.

    The equations of motion as what an integrator takes: velocities and accelerations.
    """
    return jax.lax.platform_dependent(
        c, delta, qd, tau, cpu=_rates_in_one_loop, default=_rates
    )


@rates.defjvp
def _rates_jvp(primals, tangents):
    return jax.jvp(_rates, primals, tangents)


@compiled(q=(3,), qd=(3,), tau=(3,))
def forward_dynamics(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    tau: Float[Array, " joint"],
) -> Float[Array, " joint"]:
    """Joint accelerations under joint efforts: the reduced form of (14), 3x3.

    Equal to the paper's masked equations (17)-(27), and regular in cases where those
    are singular (a massless revolute tip, for instance).

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s], `tau` [N or N m].

    **Returns:** `qdd` [m/s^2 or rad/s^2].
    """
    _, qdd = rates(link_constants(linkage, q), zeros(q), tuple(qd), tuple(tau))
    return jnp.stack(qdd)


@compiled(q=(3,), qd=(3,), qdd=(3,))
def inverse_dynamics(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    qdd: Float[Array, " joint"],
) -> Float[Array, " joint"]:
    """Joint efforts that produce given joint accelerations, from (14) reduced.

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s], `qdd` [m/s^2 or rad/s^2].

    **Returns:** `tau` [N or N m].
    """
    m = _equations(link_constants(linkage, q), zeros(q), tuple(qd))
    matrix = jnp.array(
        [[m.m11, m.m12, m.m13], [m.m12, m.m22, m.m23], [m.m13, m.m23, m.m33]]
    )
    return matrix @ qdd + jnp.stack(m.bias)


@compiled(q=(3,), qd=(3,))
def link_energies(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
) -> tuple[Float[Array, " link"], Float[Array, " link"]]:
    """Kinetic and potential energy of each moving link, (6) and (7).

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s].

    **Returns:** two arrays [J]; the potential is zero at the ground pivot's height.
    """
    velocity, rate = mass_center_velocities(linkage, q, qd)
    kinetic = linkage.mass * jnp.sum(velocity**2, axis=1) + linkage.inertia * rate**2
    height = mass_centers(linkage, q)[:, 1]
    return kinetic / 2, linkage.mass * linkage.gravity * height


@compiled(q=(3,), qd=(3,))
def energy(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Kinetic and potential energy of the linkage, (6) and (7).

    **Arguments:** `q` [m or rad], `qd` [m/s or rad/s].

    **Returns:** two numbers [J]; the potential is zero at the ground pivot's height.
    """
    kinetic, potential = link_energies(linkage, q, qd)
    return jnp.sum(kinetic), jnp.sum(potential)
