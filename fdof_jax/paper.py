"""The paper's six equations in its chain coordinates, masked by existence factors.

x = (B1, th2, B2, th3, B3, th4) with absolute angles. Misprints are corrected where
marked. `dynamics` holds the reduced form that simulations use.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .base.checks import concrete, real_array
from .base.known_values import at_once
from .base.trigonometry import sincos
from .linkage.coordinates import State
from .linkage.linkage import Linkage, compiled, joints_of
from .linkage.topology import letters, pairs_of, real_joints

__all__ = [
    "bias_force", "constraint_forces", "from_chain", "masked_accelerations",
    "mass_matrix", "to_chain",
]  # fmt: skip
__dir__ = __all__.copy


@compiled("q", "qd")
def to_chain(
    linkage: Linkage, q: Float[Array, " joint"], qd: Float[Array, " joint"]
) -> tuple[Float[Array, " chain"], Float[Array, " chain"]]:
    """Computes chain coordinates (B1, th2, B2, th3, ...) and their rates.

    Angles are absolute, as in the paper; fictitious joints stand at `linkage.locked`.

    **Arguments:** `q`, `qd`: joint positions [m or rad] and velocities.

    **Returns:** `x` [m, rad] and `xd` [m/s, rad/s].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> x, xd = fj.paper.to_chain(arm, [0.5, 2.5, 0.0], [1.0, 0.0, 0.0])
    >>> x.tolist(), xd.tolist()  # a slide keeps its angle
    ([0.0, 0.5, 2.5, 2.071, 0.0, 2.071], [0.0, 1.0, 0.0, 1.0, 0.0, 1.0])
    """
    revolute = jnp.stack(real_joints(linkage.ef))
    slide = jnp.where(revolute, linkage.locked, q)
    turn = jnp.where(revolute, q, linkage.locked)
    x = jnp.stack([slide, linkage.base_angle + jnp.cumsum(turn)], axis=1)
    xd = jnp.stack(
        [jnp.where(revolute, 0, qd), jnp.cumsum(jnp.where(revolute, qd, 0))], axis=1
    )
    return x.ravel(), xd.ravel()


def from_chain(
    topology: str | ArrayLike, x: ArrayLike, xd: ArrayLike, base_angle: ArrayLike = 0.0
) -> tuple[Float[Array, " joint"], State]:
    """Computes locked positions and joint state from the paper's chain coordinates.

    **Arguments:**

    - `topology`: as for `Linkage`, without fixed pairs.
    - `x`, `xd`: (B1, th2, B2, th3, ...), absolute angles [m, rad], and rates.
    - `base_angle`: th1 [rad].

    **Returns:** `locked` for `Linkage`, and the `State`.

    **Raises:** ValueError for malformed input, and for velocities that would move a
    fictitious joint.

    >>> import fdof_jax as fj
    >>> locked, state = fj.paper.from_chain("RPR", [0, 1.5, 2.5, 2.5, 0, 2], [0] * 6)
    >>> locked.tolist(), state.q.tolist()
    ([0.0, 1.0, 0.0], [1.5, 2.5, -0.5])
    """
    pairs = pairs_of(topology)
    if pairs is not None and not pairs.any(axis=1).all():
        raise ValueError(
            "topology: expected no fixed pair with chain coordinates, got "
            f"{letters(pairs)}."
        )
    ef = jnp.asarray(topology) if pairs is None else pairs.ravel()
    x = real_array("x", x, (ef.size,))
    xd = real_array("xd", xd, (ef.size,))
    base_angle = real_array("base_angle", base_angle, ())
    locked, held, state = _joints_of_chain(jnp.asarray(ef, float), x, xd, base_angle)
    held = concrete(held)
    if pairs is not None and held is not None:
        # Differences of absolute rates carry rounding errors.
        scale = np.abs(np.asarray(xd)).max()
        for k in np.flatnonzero(np.abs(held) > 8 * np.finfo(held.dtype).eps * scale):
            rate = f"th{k + 2} rate equal to th{k + 1} rate" if k else "th2 rate 0"
            if pairs[k, 1]:
                rate = f"B{k + 1} rate 0"
            raise ValueError(
                f"xd: expected {rate}, because that joint is fictitious, got a "
                f"difference of {held[k]:g}."
            )
    return locked, state


@at_once
def _joints_of_chain(
    ef: Array, x: Array, xd: Array, base_angle: Array
) -> tuple[Array, Array, State]:
    """Returns positions and rates of the fictitious joints, and of the real ones."""
    revolute = jnp.stack(real_joints(ef))
    slide, turn = x[0::2], jnp.diff(x[1::2], prepend=base_angle)
    slide_rate, turn_rate = xd[0::2], jnp.diff(xd[1::2], prepend=0)
    pick = lambda first, second: jnp.where(revolute, first, second)
    state = State(pick(turn, slide), pick(turn_rate, slide_rate))
    return pick(slide, turn), pick(slide_rate, turn_rate), state


def of_three_pairs(linkage: Linkage, x: ArrayLike) -> Array:
    """Returns `x` of a linkage of three pairs of joints, or raises ValueError."""
    if joints_of(linkage) != 3:
        raise ValueError(
            "linkage: expected three pairs of joints, as in the paper's equations, got "
            f"{joints_of(linkage)}."
        )
    return real_array("x", x, (6,))


@compiled(x=of_three_pairs)
def mass_matrix(
    linkage: Linkage, x: Float[Array, " chain"]
) -> Float[Array, "chain chain"]:
    """Computes the 6x6 mass matrix of the chain: left sides of (8)-(13).

    **Arguments:** `x`: (B1, th2, B2, th3, B3, th4), absolute angles [m, rad].

    **Returns:** entries [kg], [kg m] or [kg m^2], by the coordinates.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.paper.mass_matrix(arm, [0.0] * 6)[0].tolist()  # of a push on the ground
    [3.0, 3.0, 2.0, 2.0, 1.0, 1.0]
    """
    _, th2, B2, th3, B3, th4 = x
    th1 = linkage.base_angle
    _, A2, A3, _ = linkage.length
    m2, m3, m4 = linkage.mass
    I2, I3, I4 = linkage.inertia
    (p2, q2), (p3, q3), (p4, q4) = linkage.com
    s12, c12 = sincos(th1 - th2)
    s13, c13 = sincos(th1 - th3)
    s14, c14 = sincos(th1 - th4)
    s23, c23 = sincos(th2 - th3)
    s24, c24 = sincos(th2 - th4)
    s34, c34 = sincos(th3 - th4)
    M11 = m2 + m3 + m4
    M12 = (m2 * q2 + B2 * (m3 + m4)) * s12 + (m2 * p2 + A2 * (m3 + m4)) * c12
    M13 = (m3 + m4) * c12
    M14 = (m3 * q3 + m4 * B3) * s13 + (m3 * p3 + m4 * A3) * c13
    M15 = m4 * c13
    M16 = m4 * (q4 * s14 + p4 * c14)
    M22 = I2 + m2 * (p2**2 + q2**2) + (m3 + m4) * (A2**2 + B2**2)
    M23 = A2 * (m3 + m4)
    # (11) prints this coefficient with a brace that leaves the cosine term outside.
    M24 = (m3 * (A2 * q3 - B2 * p3) + m4 * (A2 * B3 - B2 * A3)) * s23 + (
        m3 * (A2 * p3 + B2 * q3) + m4 * (A2 * A3 + B2 * B3)
    ) * c23
    M25 = m4 * (A2 * c23 - B2 * s23)
    M26 = m4 * ((A2 * q4 - B2 * p4) * s24 + (A2 * p4 + B2 * q4) * c24)
    M33 = m3 + m4
    M34 = (m3 * q3 + m4 * B3) * s23 + (m3 * p3 + m4 * A3) * c23
    M35 = m4 * c23
    M36 = m4 * (q4 * s24 + p4 * c24)
    M44 = I3 + m3 * (p3**2 + q3**2) + m4 * (A3**2 + B3**2)
    M45 = m4 * A3
    M46 = m4 * ((A3 * q4 - B3 * p4) * s34 + (A3 * p4 + B3 * q4) * c34)
    M55 = m4
    M56 = m4 * (q4 * s34 + p4 * c34)
    # (13) prints L4 for I4.
    M66 = I4 + m4 * (p4**2 + q4**2)
    return jnp.array(
        [
            [M11, M12, M13, M14, M15, M16],
            [M12, M22, M23, M24, M25, M26],
            [M13, M23, M33, M34, M35, M36],
            [M14, M24, M34, M44, M45, M46],
            [M15, M25, M35, M45, M55, M56],
            [M16, M26, M36, M46, M56, M66],
        ]
    )


@compiled(x=of_three_pairs, xd=(6,))
def bias_force(
    linkage: Linkage, x: Float[Array, " chain"], xd: Float[Array, " chain"]
) -> Float[Array, " chain"]:
    """Computes phi of (14): velocity-dependent forces and gravity in (8)-(13).

    **Arguments:** `x`, `xd`: chain coordinates and rates [m, rad, m/s, rad/s].

    **Returns:** generalised forces [N, N m], without efforts.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.paper.bias_force(arm, [0.0] * 6, [0.0] * 6).tolist()  # weights, arm level
    [-29.43, -29.43, -19.62, -19.62, -9.81, -9.81]
    """
    _, th2, B2, th3, B3, th4 = x
    _, w2, v2, w3, v3, w4 = xd
    th1 = linkage.base_angle
    g = linkage.gravity
    _, A2, A3, _ = linkage.length
    m2, m3, m4 = linkage.mass
    (p2, q2), (p3, q3), (p4, q4) = linkage.com
    _, c1 = sincos(th1)
    s2, c2 = sincos(th2)
    s3, c3 = sincos(th3)
    s4, c4 = sincos(th4)
    s12, c12 = sincos(th1 - th2)
    s13, c13 = sincos(th1 - th3)
    s14, c14 = sincos(th1 - th4)
    s23, c23 = sincos(th2 - th3)
    s24, c24 = sincos(th2 - th4)
    s34, c34 = sincos(th3 - th4)
    phi_B1 = (
        -(m2 + m3 + m4) * g * c1
        - (m2 * p2 * w2**2 + w2 * (A2 * w2 + 2 * v2) * (m3 + m4)) * s12
        + (m2 * q2 * w2**2 + B2 * w2**2 * (m3 + m4)) * c12
        - (m3 * p3 * w3**2 + m4 * w3 * (A3 * w3 + 2 * v3)) * s13
        + w3**2 * (m3 * q3 + m4 * B3) * c13
        - m4 * p4 * w4**2 * s14
        + m4 * q4 * w4**2 * c14
    )
    phi_th2 = (
        -(m3 + m4) * (2 * B2 * v2 * w2 + g * (A2 * c2 - B2 * s2))
        - m2 * g * (p2 * c2 - q2 * s2)
        - (
            m3 * w3**2 * (A2 * p3 + B2 * q3)
            + m4 * (2 * A2 * v3 * w3 + w3**2 * (A2 * A3 + B2 * B3))
        )
        * s23
        - (
            -m3 * w3**2 * (A2 * q3 - B2 * p3)
            + m4 * (2 * B2 * v3 * w3 - w3**2 * (A2 * B3 - B2 * A3))
        )
        * c23
        - w4**2 * m4 * (A2 * p4 + B2 * q4) * s24
        + w4**2 * m4 * (A2 * q4 - B2 * p4) * c24
    )
    # (10) prints A2 for A3 in the second group, wrong wherever they differ.
    phi_B2 = (
        (m3 + m4) * (B2 * w2**2 - g * c2)
        - (m3 * p3 * w3**2 + m4 * w3 * (A3 * w3 + 2 * v3)) * s23
        + w3**2 * (m3 * q3 + m4 * B3) * c23
        - m4 * p4 * w4**2 * s24
        + m4 * q4 * w4**2 * c24
    )
    phi_th3 = (
        -m3 * g * (p3 * c3 - q3 * s3)
        - m4 * (2 * B3 * v3 * w3 + g * (A3 * c3 - B3 * s3))
        + (
            m3 * (2 * p3 * v2 * w2 + w2**2 * (A2 * p3 + B2 * q3))
            + m4 * (2 * A3 * v2 * w2 + w2**2 * (A2 * A3 + B2 * B3))
        )
        * s23
        - (
            m3 * (2 * q3 * v2 * w2 + w2**2 * (A2 * q3 - B2 * p3))
            + m4 * (2 * B3 * v2 * w2 + w2**2 * (A2 * B3 - B2 * A3))
        )
        * c23
        - m4 * w4**2 * (A3 * p4 + B3 * q4) * s34
        + m4 * w4**2 * (A3 * q4 - B3 * p4) * c34
    )
    phi_B3 = (
        m4 * (B3 * w3**2 - g * c3)
        + m4 * w2 * (A2 * w2 + 2 * v2) * s23
        + m4 * B2 * w2**2 * c23
        - m4 * p4 * w4**2 * s34
        + m4 * q4 * w4**2 * c34
    )
    phi_th4 = (
        -m4 * g * (p4 * c4 - q4 * s4)
        + m4 * (2 * p4 * v2 * w2 + w2**2 * (A2 * p4 + B2 * q4)) * s24
        - m4 * (2 * q4 * v2 * w2 + w2**2 * (A2 * q4 - B2 * p4)) * c24
        + m4 * (2 * p4 * v3 * w3 + w3**2 * (A3 * p4 + B3 * q4)) * s34
        - m4 * (2 * q4 * v3 * w3 + w3**2 * (A3 * q4 - B3 * p4)) * c34
    )
    return jnp.stack([phi_B1, phi_th2, phi_B2, phi_th3, phi_B3, phi_th4])


@compiled(x=of_three_pairs, xd=(6,), force=(6,))
def masked_accelerations(
    linkage: Linkage,
    x: Float[Array, " chain"],
    xd: Float[Array, " chain"],
    force: Float[Array, " chain"],
) -> Float[Array, " chain"]:
    """Computes the six accelerations by the EF-masked rows (17)-(27).

    The row of a real joint is its row of (15) plus the rows of the fictitious revolute
    joints beyond it. The row of a fictitious joint keeps it still: Bdd = 0, or the
    angular acceleration of the link before. The paper multiplies these rows by a mass,
    which may vanish; here the factor is 1. (In (19), the minus sign before B3dd M(5,5)
    is wrong where the last joint is prismatic.)

    **Arguments:** `x`, `xd`: chain coordinates and rates [m, rad, m/s, rad/s]; `force`:
    joint efforts (F_B1, tau_th2, ..., tau_th4) [N, N m], each revolute one reacting on
    the preceding link. Those of fictitious joints have no effect.

    **Returns:** `xdd` [m/s^2, rad/s^2].

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> level, rest = [0.0] * 6, [0.0] * 6
    >>> fj.paper.masked_accelerations(arm, level, rest, [0.0] * 6).tolist()  # it falls
    [0.0, -9.81, 0.0, 0.0, 0.0, 0.0]
    """
    real = linkage.ef > 0.5
    M = mass_matrix(linkage, x)
    # Right side of (15) without constraint efforts; torques react on the link before.
    effort = jnp.where(real, force, 0)
    effort = effort.at[1:4:2].add(-effort[3::2])
    right = effort + bias_force(linkage, x, xd)

    # The paper prints EF5 for 1 - EF6 and EF3 for 1 - EF4. The same where one joint of
    # each pair is real, they differ at fixed pairs.
    _, _, _, ef4, _, ef6 = linkage.ef

    def masked(rows: Array) -> Array:
        th4 = rows[5]
        th3 = rows[3] + (1 - ef6) * th4
        th2 = rows[1] + (1 - ef4) * th3
        return jnp.stack([rows[0], th2, rows[2], th3, rows[4], th4])

    # Columns of fictitious joints are added up likewise: their rows become those of the
    # identity. Rows of real joints are scaled, because metres and radians may differ by
    # many orders of magnitude.
    both = jnp.where(jnp.outer(real, real), masked(masked(M).T), jnp.eye(6))
    diagonal = jnp.diag(both)
    size = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))
    scaled = jnp.where(real, masked(right), 0) / size
    xdd = jnp.linalg.solve(both / jnp.outer(size, size), scaled) / size
    xdd = jnp.where(real, xdd, 0)  # elimination leaves rounding errors there
    th2 = xdd[1]
    th3 = jnp.where(real[3], xdd[3], th2)
    th4 = jnp.where(real[5], xdd[5], th3)
    return jnp.stack([xdd[0], th2, xdd[2], th3, xdd[4], th4])


@compiled(x=of_three_pairs, xd=(6,), force=(6,))
def constraint_forces(
    linkage: Linkage,
    x: Float[Array, " chain"],
    xd: Float[Array, " chain"],
    force: Float[Array, " chain"],
) -> Float[Array, " chain"]:
    """Computes the generalised constraint forces at fictitious joints, (16)-(26).

    Added to a fictitious joint's command in `force`, this force keeps the joint still.
    It equals the printed forms ((24) prints an equals sign for a plus).

    **Arguments:** as for `masked_accelerations`.

    **Returns:** forces and torques [N, N m], zero at real joints.

    >>> import fdof_jax as fj
    >>> arm, start, *_ = fj.scenes.fig7()
    >>> x, xd = fj.paper.to_chain(arm, *start)
    >>> fj.paper.constraint_forces(arm, x, xd, [0.0] * 6).tolist()  # the guide's: 4th
    [10.921, 0.0, 0.0, -0.925, -0.555, 0.0]
    """
    xdd = masked_accelerations(linkage, x, xd, force)
    effort = mass_matrix(linkage, x) @ xdd - bias_force(linkage, x, xd)
    revolute = jnp.cumsum(effort[::-2])[::-1]  # each revolute joint carries the next
    total = jnp.stack([effort[0::2], revolute], axis=1).reshape(6)
    return jnp.where(linkage.ef > 0.5, 0, total - force)
