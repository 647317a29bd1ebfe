"""Inverse kinematics: joint positions for a commanded tip."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import concrete, real_array, sign
from ..linkage.frames import cross, dot, unit_vector
from ..linkage.linkage import Linkage, check_linkage
from ..linkage.topology import real_joints
from ..xla.array_namespace import in_numpy, namespace, plane_vector


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

    - `angle`: angles of the ground and the three links (4,) [rad]. Those of links 2
      and 3 follow from the ground or from the last link, or are arbitrary.
    - `vector`: unit vectors x + iy of these angles (4,).
    """

    angle: Array
    vector: Array


def known_directions(linkage: Linkage, orientation: Array) -> Directions:
    """Computes directions that follow from the ground or the last link's angle."""
    xp = namespace(linkage, orientation)
    r1, _, r3 = real_joints(linkage.ef)
    lock1, lock2, lock3 = linkage.locked
    from_tip = orientation - lock3
    second = xp.where(r1, from_tip - lock2, linkage.base_angle + lock1)
    third = xp.where(r3, second + lock2, from_tip)
    angle = xp.stack([linkage.base_angle, second, third, orientation])
    return Directions(angle, unit_vector(angle))


def unmoved_part(linkage: Linkage, directions: Directions) -> Array:
    """Computes the sum of the ground's and the last link's vectors, x + iy [m].

    No joint moves this part of the tip's position. The rest is the wrist vector, from
    the first joint's start to the last link's start.
    """
    xp = namespace(linkage, directions)
    r1, _, _ = real_joints(linkage.ef)
    fixed = plane_vector(linkage.length[0], xp.where(r1, linkage.locked[0], 0))
    e1, _, _, e4 = directions.vector
    return e1 * fixed + e4 * linkage.length[3]


def solve_joints(
    linkage: Linkage,
    directions: Directions,
    wrist: Array,
    bearing: Array,
    branch: Array,
) -> tuple[Array, Array]:
    """Computes joint positions (..., 3) from the wrist x + iy, NaN if out of reach.

    The second result is a root that is 0 just at the edge of the reach, where
    velocities are infinite.

    `bearing` is the direction angle of `wrist`. As an argument it can be continuous
    along a path that winds around the pivot.

    The vectors of links 2 and 3 and the slides add up to the wrist vector. Two of these
    parts are unknown, in three kinds: two vectors of known lengths (RRR), one vector of
    known length and one slide of known direction (RRP, PRR, and RPR as seen from link
    2, where the wrist vector turns), two slides (PPR, RPP, PRP). The first two kinds
    need a square root, whose sign is the branch.
    """
    xp = namespace(linkage, directions, wrist, bearing, branch)
    r1, r2, r3 = revolute = real_joints(linkage.ef)
    # Which vectors turn by themselves: link 2's, link 3's, or the wrist's as a whole.
    turning2, turning3, whole = r1 & r2, r2 & r3, r1 & r3
    two_turning, framed = whole & r2, whole & ~r2  # RRR, RPR
    two_slides = ~(turning2 | turning3 | whole)
    th1, th2, th3, th4 = directions.angle
    e1, e2, e3, _ = directions.vector

    # Vectors of links 2 and 3 in their own frames; a free slide counts as 0.
    free = xp.stack([r2, r3])
    d = plane_vector(linkage.length[1:3], xp.where(free, linkage.locked[1:], 0))
    reach2, reach3 = dot(d, d)
    own2, own3 = plane_angle(d.imag, d.real)

    # What the known vectors leave of the wrist vector, along the directions a and b:
    # the slides run across a and, if there are two, across b.
    turns = xp.stack([turning2, turning3])
    known = xp.where(turns, 0, d * directions.vector[1:3]).sum()
    rest = xp.where(framed, known, wrist - known)
    a = xp.where(r1, xp.where(r2, e3, e2), e1)
    b = xp.where(two_slides, xp.where(r3, e2, e3), 1j * a)
    span = cross(a, b)  # sine of the angle between two slides
    parallel = xp.abs(span) <= 16 * np.finfo(span.dtype).eps
    span = xp.where(parallel, xp.nan, span)

    # A turning vector is known by its length and its component along a. For two, the
    # same holds of their product, one conjugated, by the law of cosines.
    square = dot(wrist, wrist)
    inner = (square - reach2 - reach3) / 2
    component = dot(a, rest)
    along = xp.where(two_turning, inner, component)
    size = xp.where(turning2, reach2, 1) * xp.where(turning3, reach3, 1)
    size = xp.where(framed, square, size)
    with np.errstate(invalid="ignore"):  # NaN out of reach is intended
        root = branch * xp.sqrt(xp.where(two_slides, 1, size - along**2))

    angle = plane_angle(root, along + xp.where(two_turning, reach2, 0))
    second = xp.where(whole, bearing - angle, xp.where(turning2, th3 + angle, th2))
    second = second - xp.where(turning2, own2, 0)
    bend = xp.where(r2, own2 + plane_angle(root, inner) - own3, linkage.locked[1])
    third = xp.where(whole, second + bend, xp.where(turning3, th1 + angle - own3, th3))
    slide = dot(b, rest) / span - xp.where(two_slides, 0, root)
    other = xp.where(two_slides, -component / span, slide)
    turned = second - th1, third - second, th4 - third
    slid = slide, xp.where(framed, -slide, xp.where(r1, slide, other)), other
    q = [xp.where(*joint) for joint in zip(revolute, turned, slid)]
    return xp.stack(q, axis=-1), root


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
    wrist = plane_vector(*point) - unmoved_part(arm, directions)
    bearing = plane_angle(wrist.imag, wrist.real)
    bearing = bearing - 2 * np.pi * whole_turns(bearing)
    q, _ = solve_joints(arm, directions, wrist, bearing, side)
    values = concrete(q)
    if values is not None and not np.isfinite(values).all():
        raise ValueError(
            f"tip: expected a point within reach at orientation {angle:g} rad, "
            f"got {tip.tolist()}."
        )
    return jnp.asarray(q, dtype=float)
