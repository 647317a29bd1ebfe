"""The reduced 3x3 equations of motion, in scalars.

The equations use scalars, never stacked arrays, because XLA on CPU computes a stacked
result once per entry. Positions are displacements from a reference configuration, which
turn the reference's directions. A pendulum 1e-17 rad away from upright therefore keeps
that angle, which upright + 1e-17 would lose, and an arm that starts after a million
turns moves as it would have before. The algebra is a composite-body recursion from the
tip: S(EF)^T M S(EF) of the paper's six equations, without forming them. Per joint, the
existence factor selects between turning about a point and sliding along a direction.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ..linkage.coordinates import to_chain
from ..linkage.linkage import Linkage
from ..linkage.topology import real_joints
from ..xla.trigonometry import sincos

Scalars = tuple[Array, ...]
Vector = tuple[Array, Array]
Directions = tuple[Vector, Vector, Vector]


class Constants(NamedTuple):
    """Scalars of a linkage for the equations, computed once per solve.

    - `e_n`, `b_n`: directions of the links and slides B_n [m] at the reference.
    - `m34` = m3 + m4, and so on.
    - `(s_n, t_n)`: first moment of link n along and across the link [kg m], with the
      mass beyond it at the end of its vector A_n.
    - `j_n`: second moments about the start of link n [kg m^2]; `j34` = j3 + j4.
    - `slide_on_slide`: whether the last two joints are prismatic.
    - `slide2`: the inertia [kg] of the first of these while the other is free, m3 + m4
      sin^2 of the angle between them; m34 - m4 cos^2 would cancel at small angles.
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
    j34: Array
    j4: Array
    slide_on_slide: Array
    slide2: Array


def link_constants(
    linkage: Linkage,
    q: Float[Array, " joint"],
    sincos: Callable[[Array], tuple[Array, Array]] = sincos,
) -> Constants:
    """Computes the scalars that `rates` needs, with `q` as reference.

    `sincos` may be one for large angles. Directions are combined instead of angles,
    because the sum of large angles is rounded.
    """
    x, _ = to_chain(linkage, q, jnp.zeros_like(q))
    r1, r2, r3 = real_joints(linkage.ef)
    turns = jnp.where(jnp.stack([r1, r2, r3]), q, linkage.locked)
    sin, cos = sincos(jnp.concatenate([linkage.base_angle[None], turns]))
    e1, *turned = zip(cos, sin)
    e2 = _in_frame(*turned[0], e1)
    e3 = _in_frame(*turned[1], e2)
    e4 = _in_frame(*turned[2], e3)
    m2, m3, m4 = linkage.mass
    _, a2, a3, _ = linkage.length
    (s2, t2), (s3, t3), (s4, t4) = linkage.mass[:, None] * linkage.com
    j2, j3, j4 = linkage.inertia + linkage.mass * jnp.sum(linkage.com**2, axis=1)
    m34 = m3 + m4
    return Constants(
        revolute=(r1, r2, r3),
        e1=e1, e2=e2, e3=e3, e4=e4,
        b2=x[2], b3=x[4],
        gravity=linkage.gravity,
        m4=m4, m34=m34, m234=m2 + m34,
        a2=a2, a3=a3,
        s2=s2 + m34 * a2, t2=t2, s3=s3 + m4 * a3, t3=t3, s4=s4, t4=t4,
        j2=j2 + m34 * a2**2, j34=j3 + m4 * a3**2 + j4, j4=j4,
        slide_on_slide=~(r2 | r3), slide2=m3 + m4 * turned[1][1] ** 2,
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


class Equations(NamedTuple):
    """M qdd + bias = tau, with M symmetric (kg m^2, kg m or kg by joint types)."""

    m11: Array
    m12: Array
    m13: Array
    m22: Array
    m23: Array
    m33: Array
    bias: Scalars


def turns(c: Constants, delta: Scalars) -> Scalars:
    """Computes the angles by which displacements turn the three links [rad]."""
    r1, r2, r3 = c.revolute
    turned2 = jnp.where(r1, delta[0], 0)
    turned3 = turned2 + jnp.where(r2, delta[1], 0)
    return turned2, turned3, turned3 + jnp.where(r3, delta[2], 0)


def directions(c: Constants, delta: Scalars) -> Directions:
    """Computes the unit vectors along the three links, turned by displacements."""
    e2, e3, e4 = map(_turn, (c.e2, c.e3, c.e4), turns(c, delta))
    return e2, e3, e4


def equations(
    c: Constants, delta: Scalars, qd: Scalars, turned: Directions | None = None
) -> Equations:
    """Computes the equations of motion: (8)-(13) projected on the real joints.

    `turned`: the `directions` at `delta`, if the caller has them.
    """
    r1, r2, r3 = c.revolute
    b2 = c.b2 + jnp.where(r2, 0, delta[1])
    b3 = c.b3 + jnp.where(r3, 0, delta[2])
    w2 = jnp.where(r1, qd[0], 0)
    turn3 = jnp.where(r2, qd[1], 0)
    turn4 = jnp.where(r3, qd[2], 0)
    w3 = w2 + turn3
    w4 = w3 + turn4

    n1 = _perp(c.e1)
    e2, e3, e4 = directions(c, delta) if turned is None else turned
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
    k3 = c.j34 + c.m4 * b3 * b3 + 2 * _dot(d3, u4)
    k2 = c.j2 + c.m34 * b2 * b2 + 2 * _dot(d2, c3) + k3

    # Linear momentum, and angular momentum about the joint, of the links beyond a joint
    # that moves at unit rate; each joint before it takes a share.
    p3 = _select(r3, _perp(u4), (c.m4 * n3[0], c.m4 * n3[1]))
    p2 = _select(r2, _perp(c3), (c.m34 * n2[0], c.m34 * n2[1]))
    h3 = jnp.where(r3, c.j4, _cross(u4, n3))
    h2 = jnp.where(r2, k3, _cross(c3, n2))
    h3_at_2 = h3 + _cross(d3, p3)

    # Efforts that keep all joints at constant rate, gravity included. Differences of
    # squared angular velocities are written as products with the joint rates, because
    # absolute rates may be large and nearly equal.
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
    return Equations(
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
    """Returns zero displacements, rates or efforts in the dtype of `q`."""
    zero = jnp.zeros_like(q[0])
    return zero, zero, zero
