"""Inverse kinematics: joint positions for a commanded tip."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.array_namespace import in_numpy, namespace, plane_vector
from ..base.checks import concrete, is_traced, real_array, sign
from ..linkage.frames import cross, dot, frames, length_of, unit_vector
from ..linkage.linkage import Linkage, check_linkage, joints_of
from ..linkage.topology import fixed_pairs, real_joints


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


class Arm(NamedTuple):
    """Three joints and what is between them, as the closed form sees a linkage.

    Vectors x + iy are in the frame of the link before the joint at their end. They go
    from joint to joint, and on to the tip; a joint's own slide counts as 0.

    - `revolute`: whether the joints turn; `angle`: by how much slides turn [rad].
    - `base_angle`: direction of the link before the first joint [rad].
    - `ground`: vector to the first joint; `links`: to the second and the third (2,);
      `tip`: on to the tip [m].
    """

    revolute: tuple[Any, Any, Any]
    angle: Any
    base_angle: Any
    ground: Any
    links: Any
    tip: Any


def arm_of(linkage: Linkage, oriented: bool = True) -> tuple[Arm, "Placed"]:
    """Returns a linkage as an arm of three joints, and where its joints are in it.

    `oriented`: whether the last link's direction is commanded. Otherwise two joints
    move, and a third one that turns at the tip takes any direction.

    Raises ValueError unless three joints move, or two; for traced existence factors,
    all positions are NaN instead.
    """
    wanted, n = 2 + oriented, joints_of(linkage)
    found = None if is_traced(linkage.ef) else int(np.sum(np.asarray(linkage.ef)))
    if n < wanted or found not in (None, wanted):
        also = "" if oriented else " where no orientation is commanded"
        two = oriented and (found or n) == 2
        cure = "; two need orientation=None (of a TipTask)" if two else ""
        raise ValueError(
            f"linkage: expected {wanted} joints that move{also}, the others fixed, got "
            f"{found or n}{cure}."
        )
    xp = namespace(linkage)
    revolute = xp.stack(real_joints(linkage.ef))
    slide = xp.where(revolute, linkage.locked, 0)
    if n == wanted:
        vector = plane_vector(linkage.length[:-1], slide)
        tip = plane_vector(linkage.length[-1], xp.zeros_like(slide[0]))
        angle, base_angle, offset, place = linkage.locked, linkage.base_angle, 0, None
    else:
        # Where the chain is with its joints at 0: what is fixed keeps its shape.
        zero = xp.zeros_like(linkage.locked)
        f = frames(linkage, zero)
        start, direction, angles = f.start, f.direction, f.angle
        fixed = xp.stack(fixed_pairs(linkage.ef))
        place = xp.argsort(fixed, stable=True)[:wanted]
        begins = xp.concatenate([xp.zeros_like(place[:1]), place + 1])
        ends = xp.concatenate([place, xp.full_like(place[:1], n)])
        turned = angles[ends] - angles[begins]  # within a rigid part
        end = xp.concatenate([start[1:], f.tip(linkage)[None]])
        vectors = (end[ends] - start[begins]) * direction[ends].conj()
        vector, tip = vectors[:-1], vectors[-1]
        revolute = revolute[place]
        angle = linkage.locked[place] + turned[1:]
        base_angle = angles[ends[0]]
        offset = xp.where(revolute, turned[1:], vector.imag)
        vector = plane_vector(vector.real, xp.where(revolute, vector.imag, 0))
    if not oriented:
        one = xp.ones_like(revolute[:1])
        revolute, angle = (
            xp.concatenate([a, b]) for a, b in ((revolute, one), (angle, angle[:1]))
        )
        vector, tip = xp.concatenate([vector, tip[None]]), xp.zeros_like(tip)
    valid = 0
    if found is None:
        valid = xp.where(xp.sum(linkage.ef) == wanted, 0, xp.nan)
    arm = Arm(tuple(revolute), angle, base_angle, vector[0], vector[1:], tip)
    return arm, Placed(place, offset, valid, n)


class Placed(NamedTuple):
    """Places of an `Arm`'s joints among the n of a linkage that has more.

    `offset`: what the positions have beyond those in the linkage [m or rad].
    `valid`: 0, or NaN if another number of joints moves.
    """

    place: Any
    offset: Any
    valid: Any
    n: int

    def __call__(self, q: Any) -> Any:
        """Returns positions in the linkage (..., n), from those of the arm (..., 3)."""
        if self.place is None:
            return q[..., : self.n] + self.valid
        xp = namespace(q, self.place, self.offset)
        at = xp.arange(self.n)[:, None] == self.place[None]
        moved = q[..., : len(self.place)] - self.offset
        return xp.where(at, moved[..., None, :], 0).sum(axis=-1) + self.valid


class Directions(NamedTuple):
    """Directions of the links that do not depend on the tip's position.

    - `angle`: angles of the ground and the three links (4,) [rad]. Those of links 2
      and 3 follow from the ground or from the last link, or are arbitrary.
    - `vector`: unit vectors x + iy of these angles (4,).
    """

    angle: Array
    vector: Array


def known_directions(arm: Arm, orientation: Array) -> Directions:
    """Computes directions that follow from the ground or the last link's angle."""
    xp = namespace(arm, orientation)
    r1, _, r3 = arm.revolute
    lock1, lock2, lock3 = arm.angle
    from_tip = orientation - lock3
    second = xp.where(r1, from_tip - lock2, arm.base_angle + lock1)
    third = xp.where(r3, second + lock2, from_tip)
    angle = xp.stack([arm.base_angle, second, third, orientation])
    return Directions(angle, unit_vector(angle))


def unmoved_part(arm: Arm, directions: Directions) -> Array:
    """Computes the sum of the ground's and the last link's vectors, x + iy [m].

    No joint moves this part of the tip's position. The rest is the wrist vector, from
    the first joint's start to the last link's start.
    """
    e1, _, _, e4 = directions.vector
    return e1 * arm.ground + e4 * arm.tip


def solve_joints(
    arm: Arm, directions: Directions, wrist: Array, bearing: Array, branch: Array
) -> tuple[Array, Array]:
    """Computes positions of the arm (..., 3) from the wrist x + iy, NaN out of reach.

    The second result is a root that is 0 just at the edge of the reach, or beyond it by
    rounding. Velocities are not finite there.

    `bearing` is the direction angle of `wrist`. As an argument it can be continuous
    along a path that winds around the pivot.

    The vectors of links 2 and 3 and the slides add up to the wrist vector. Two of these
    parts are unknown, in three kinds: two vectors of known lengths (RRR), one vector of
    known length and one slide of known direction (RRP, PRR, and RPR as seen from link
    2, where the wrist vector turns), two slides (PPR, RPP, PRP). The first two kinds
    need a square root, whose sign is the branch.
    """
    xp = namespace(arm, directions, wrist, bearing, branch)
    r1, r2, r3 = arm.revolute
    # Which vectors turn by themselves: link 2's, link 3's, or the wrist's as a whole.
    turning2, turning3, whole = r1 & r2, r2 & r3, r1 & r3
    two_turning, framed = whole & r2, whole & ~r2  # RRR, RPR
    two_slides = ~(turning2 | turning3 | whole)
    th1, th2, th3, th4 = directions.angle
    e1, e2, e3, _ = directions.vector

    d = arm.links
    square2, square3 = dot(d, d)
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
    inner = (square - square2 - square3) / 2
    component = dot(a, rest)
    along = xp.where(two_turning, inner, component)
    # What is left across a is a root. For two it is that of a product of what is left
    # to both edges of the reach, which are exact where the arm folds.
    length2, length3 = length_of(d)
    longest = xp.where(turning2, square2, 0) + xp.where(turning3, square3, 0)
    longest = xp.where(framed, square, longest)
    longest = xp.where(two_turning, (length2 + length3) ** 2, longest)
    outer = longest - xp.where(two_turning, square, component**2)
    outer = xp.where(two_slides, 1, outer)
    inmost = xp.where(two_turning, square - (length2 - length3) ** 2, 4)
    # Computed positions of tips are off by less.
    sizes = dot(arm.ground, arm.ground) + dot(arm.tip, arm.tip) + square2 + square3
    rounding = 64 * np.finfo(square.dtype).eps * (1 + abs(th4)) * (sizes + square)
    beyond = xp.minimum(outer, inmost) < -rounding
    product = xp.maximum(outer, 0) * xp.maximum(inmost, 0) / 4
    root = branch * xp.sqrt(xp.where(beyond, xp.nan, product))

    angle = plane_angle(root, along + xp.where(two_turning, square2, 0))
    second = xp.where(whole, bearing - angle, xp.where(turning2, th3 + angle, th2))
    second = second - xp.where(turning2, own2, 0)
    bend = xp.where(r2, own2 + plane_angle(root, inner) - own3, arm.angle[1])
    third = xp.where(whole, second + bend, xp.where(turning3, th1 + angle - own3, th3))
    slide = dot(b, rest) / span - xp.where(two_slides, 0, root)
    other = xp.where(two_slides, -component / span, slide)
    turned = second - th1, third - second, th4 - third
    slid = slide, xp.where(framed, -slide, xp.where(r1, slide, other)), other
    q = [xp.where(*joint) for joint in zip(arm.revolute, turned, slid)]
    return xp.stack(q, axis=-1), root


def inverse_kinematics(
    linkage: Linkage, tip: ArrayLike, orientation: ArrayLike | None, *, branch: int = 1
) -> Float[Array, " joint"]:
    """Computes joint positions for a tip position and a direction of the last link.

    The solution is in closed form for every topology of three joints that move, and of
    two where no orientation is commanded. It is selected by the existence factors;
    fixed pairs may be anywhere. The direction from the first joint to the last link's
    start is in (-pi, pi]; the angles follow from it without wrapping.

    **Arguments:**

    - `tip`: the point (x, y) [m].
    - `orientation`: the absolute angle of the last link [rad], th4 in the paper; None
      for an arm of two joints.
    - `branch`: 1 or -1, the choice between two assemblies: the sign of the turn from
      A2 to A3 (RRR), of the slide measured from the foot of the perpendicular (RPR), or
      of the side of the turning vector (PRR, RRP). Two joints are as with a third that
      turns at the tip. Ignored where there is only one assembly.

    **Returns:** `q` [m or rad], 0 at fixed pairs; NaN for traced arguments if the point
    is out of reach. A point beyond the reach by rounding is on its edge. There the two
    assemblies meet, and derivatives in the point do not exist: they are not finite.
    Close to it, joints move as the root of the distance from the edge, so that a point
    known to 1e-16 m may leave them known to 1e-8 rad.

    **Raises:** ValueError for malformed arguments, for a linkage of another number of
    joints, and for concrete arguments if the point is out of reach.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> q = fj.inverse_kinematics(arm, tip=[-5, 2], orientation=1.5707963)
    >>> q.tolist(), fj.tip_position(arm, q).tolist()
    ([1.571, 2.5, -1.571], [-5.0, 2.0])
    """
    check_linkage(linkage)
    oriented = orientation is not None
    tip = real_array("tip", tip, (2,))
    direction = orientation if oriented else 0.0
    direction = real_array("orientation", direction, (), unit="rad")
    side = sign("branch", branch)
    # NumPy computes concrete values, as JAX would compile each single operation.
    known, point, angle, side = in_numpy((linkage, tip, direction, side))
    arm, placed = arm_of(known, oriented)
    directions = known_directions(arm, angle)
    wrist = plane_vector(*point) - unmoved_part(arm, directions)
    bearing = plane_angle(wrist.imag, wrist.real)
    bearing = bearing - 2 * np.pi * whole_turns(bearing)
    q = placed(solve_joints(arm, directions, wrist, bearing, side)[0])
    values = concrete(q)
    if values is not None and not np.isfinite(values).all():
        at = f" at orientation {angle:g} rad" if oriented else ""
        raise ValueError(f"tip: expected a point within reach{at}, got {tip.tolist()}.")
    return jnp.asarray(q, dtype=float)
