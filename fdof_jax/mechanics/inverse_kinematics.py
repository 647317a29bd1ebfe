"""Inverse kinematics: joint positions for a commanded tip."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import concrete, real_array, sign
from ..linkage.frames import unit_vector
from ..linkage.linkage import Linkage, check_linkage
from ..linkage.topology import real_joints
from ..xla.array_namespace import in_numpy, namespace, plane_vector
from .kinematics import as_points


def plane_angle(y: Array, x: Array) -> Array:
    """Computes atan2 with derivative zero instead of NaN at the origin."""
    xp = namespace(y, x)
    origin = (x == 0) & (y == 0)
    return xp.arctan2(y, xp.where(origin, 1, x))


def whole_turns(angle: Array) -> Array:
    """Returns the number of turns to subtract from `angle` for a value in (-pi, pi].

    The cut lies beside the negative x axis by more than rounding, so that points on
    that axis are always at +pi.
    """
    margin = float(np.sqrt(np.finfo(angle.dtype).eps))
    return namespace(angle).ceil((angle - np.pi - margin) / (2 * np.pi))


class Directions(NamedTuple):
    """Directions of the links that do not depend on the tip's position.

    - `th2`, `th3`: angles of links 2 and 3 where they follow from the ground or from
      the last link's orientation; arbitrary otherwise [rad].
    - `e1`, `e2`, `e3`, `e4`: unit vectors of the links' angles.
    - `turn`: unit vector of `locked[1]`, the angle from link 2 to link 3 in RPR arms.
    """

    th2: Array
    th3: Array
    e1: Array
    e2: Array
    e3: Array
    e4: Array
    turn: Array


def known_directions(linkage: Linkage, orientation: Array) -> Directions:
    """Computes directions that follow from the ground or the last link's angle."""
    xp = namespace(linkage, orientation)
    r1, _, r3 = real_joints(linkage.ef)
    lock1, lock2, lock3 = linkage.locked
    th3_from_tip = orientation - lock3
    th2 = xp.where(r1, th3_from_tip - lock2, linkage.base_angle + lock1)
    th3 = xp.where(r3, th2 + lock2, th3_from_tip)
    # One call for all: sine and cosine are most of the compiled code here.
    angles = xp.stack([linkage.base_angle, th2, th3, orientation, lock2])
    return Directions(th2, th3, *unit_vector(angles))


def unmoved_part(linkage: Linkage, directions: Directions) -> Array:
    """Computes the sum of the ground's and the last link's vectors, (2,).

    No joint moves this part of the tip's position. The rest is the wrist vector, from
    the first joint's start to the last link's start.
    """
    xp = namespace(linkage, directions)
    r1, _, _ = real_joints(linkage.ef)
    fixed = plane_vector(linkage.length[0], xp.where(r1, linkage.locked[0], 0))
    return as_points(directions.e1 * fixed + directions.e4 * linkage.length[3])


def solve_joints(
    linkage: Linkage,
    directions: Directions,
    wrist: Array,
    bearing: Array,
    orientation: Array,
    branch: Array,
) -> tuple[Array, Array]:
    """Computes joint positions (..., 3) from the wrist vector, NaN if out of reach.

    The second result is a root that is 0 just at the edge of the reach, where
    velocities are infinite.

    `bearing` is the direction angle of `wrist`. As an argument it can be continuous
    along a path that winds around the pivot.

    The chain up to the wrist has two free joints, in four kinds: two turning vectors
    (RRR), a turning frame in which one slide moves (RPR), one turning vector and one
    slide of known direction (PRR, RRP), two slides (PPR, RPP, PRP). All kinds but the
    last need one square root, whose sign is the branch.
    """
    xp = namespace(linkage, wrist, bearing, orientation, branch)
    r1, r2, r3 = real_joints(linkage.ef)
    th1 = linkage.base_angle
    th2_known, th3_known, e1, e2, e3, _, turn = directions
    _, a2, a3, _ = linkage.length
    _, lock2, lock3 = linkage.locked
    two_turning = r1 & r2 & r3
    framed = r1 & ~r2 & r3
    two_slides = (r1 ^ r2) & (r2 ^ r3) & ~framed | (~r1 & ~r2) | (~r2 & ~r3)
    turning_third = ~r1 & r2 & r3  # PRR: link 3 turns; in RRP it is link 2

    w = plane_vector(wrist[..., 0], wrist[..., 1])

    def dot(u: Array, v: Array) -> Array:
        return u.real * v.real + u.imag * v.imag

    def cross(u: Array, v: Array) -> Array:
        return u.real * v.imag - u.imag * v.real

    # Vectors of links 2 and 3 in their own frames; a free slide counts as 0.
    d2 = plane_vector(a2, xp.where(r2, lock2, 0))
    d3 = plane_vector(a3, xp.where(r3, lock3, 0))
    reach2, reach3 = dot(d2, d2), dot(d3, d3)

    # Two slides: the rest of the wrist vector is resolved along their directions.
    rest = w - d2 * e2 - d3 * e3
    first = 1j * xp.where(r1, e2, e1)
    second = 1j * xp.where(r3, e2, e3)
    span = cross(first, second)  # sine of the angle between the slides
    parallel = xp.abs(span) <= 16 * np.finfo(span.dtype).eps
    span = xp.where(two_slides, xp.where(parallel, xp.nan, span), 1)
    slide_first, slide_second = cross(rest, second) / span, cross(first, rest) / span

    # One turning vector, one slide along i*across: only the turning vector contributes
    # to the wrist vector's component along `across`.
    across = xp.where(turning_third, e1, e3)
    remainder = w - xp.where(turning_third, d2 * e2, d3 * e3)
    turning = xp.where(turning_third, reach3, reach2)
    along_turning = dot(across, remainder)

    # RPR: link 3 and its vector as seen from link 2.
    framed_d3 = d3 * turn
    distance = a2 + framed_d3.real

    # RRR: the law of cosines, between the vectors of links 2 and 3.
    square = dot(w, w)
    inner = (square - reach2 - reach3) / 2

    radicand = xp.where(
        two_turning,
        reach2 * reach3 - inner**2,
        xp.where(framed, square - distance**2, turning - along_turning**2),
    )
    with np.errstate(invalid="ignore"):  # NaN out of reach is intended
        root = branch * xp.sqrt(xp.where(two_slides, 1, radicand))
    base = xp.where(
        two_turning, reach2 + inner, xp.where(framed, distance, along_turning)
    )
    angle = plane_angle(root, base)
    own2, own3 = plane_angle(d2.imag, d2.real), plane_angle(d3.imag, d3.real)
    turned = xp.where(turning_third, th1, th3_known) + angle
    th2 = xp.where(
        two_turning,
        bearing - angle - own2,
        xp.where(framed, bearing - angle, xp.where(r1 & r2, turned - own2, th2_known)),
    )
    th3 = xp.where(
        two_turning,
        th2 + own2 + plane_angle(root, inner) - own3,
        xp.where(
            framed, th2 + lock2, xp.where(turning_third, turned - own3, th3_known)
        ),
    )
    slide = dot(1j * across, remainder) - root
    slide1 = xp.where(two_slides, slide_first, slide)
    slide2 = xp.where(
        framed, root - framed_d3.imag, xp.where(r1, slide_first, slide_second)
    )
    slide3 = xp.where(two_slides, slide_second, slide)
    q1 = xp.where(r1, th2 - th1, slide1)
    q2 = xp.where(r2, th3 - th2, slide2)
    q3 = xp.where(r3, orientation - th3, slide3)
    return xp.stack([q1, q2, q3], axis=-1), root


def inverse_kinematics(
    linkage: Linkage,
    tip: ArrayLike,
    orientation: ArrayLike,
    *,
    branch: int = 1,
) -> Float[Array, " joint"]:
    """Computes joint positions for a tip position and a direction of A4.

    The solution is in closed form for every topology, selected by the existence
    factors. The direction from the first joint to the last link's start is in
    (-pi, pi]; the angles follow from it without wrapping.

    **Arguments:**

    - `tip`: the point (x, y) [m].
    - `orientation`: th4, the absolute angle of the last link [rad].
    - `branch`: 1 or -1, the choice between two assemblies: the sign of the turn from
      A2 to A3 (RRR), of the slide measured from the foot of the perpendicular (RPR), or
      of the side of the turning vector (PRR, RRP). Ignored where there is only one.

    **Returns:** `q` [m or rad]; NaN for traced arguments if the point is out of reach.

    **Raises:** ValueError for malformed arguments, and for concrete arguments if the
    point is out of reach.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> q = fj.inverse_kinematics(arm, tip=[-5, 2], orientation=1.5707963)
    >>> q.tolist(), fj.tip_position(arm, q).tolist()
    ([1.571, 2.5, -1.571], [-5.0, 2.0])
    """
    check_linkage(linkage)
    tip = real_array("tip", tip, (2,))
    orientation = real_array("orientation", orientation, ())
    side = sign("branch", branch)
    # NumPy computes concrete values, as JAX would compile each single operation.
    arm, point, angle, side = in_numpy((linkage, tip, orientation, side))
    directions = known_directions(arm, angle)
    wrist = point - unmoved_part(arm, directions)
    bearing = plane_angle(wrist[1], wrist[0])
    bearing = bearing - 2 * np.pi * whole_turns(bearing)
    q, _ = solve_joints(arm, directions, wrist, bearing, angle, side)
    values = concrete(q)
    if values is not None and not np.isfinite(values).all():
        raise ValueError(
            f"tip: expected a point within reach at orientation {angle:g} rad, "
            f"got {tip.tolist()}."
        )
    return jnp.asarray(q, dtype=float)
