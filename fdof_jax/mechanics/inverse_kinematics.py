"""Inverse kinematics: joint positions for a commanded tip."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import concrete, is_traced, real_array, refusal
from ..base.known_values import at_once
from ..base.trigonometry import plane_angle
from ..linkage.frames import cross, dot, frames, length_of, plane_vector, unit_vector
from ..linkage.linkage import Linkage, check_linkage, joints_of
from ..linkage.topology import real_joints
from .equations import Scalars


def whole_turns(angle: Array) -> Array:
    """Returns the number of turns to subtract from `angle` for a value in (-pi, pi]."""
    # The cut lies beside the negative x axis, so that points on it are always at +pi.
    margin = float(np.sqrt(np.finfo(angle.dtype).eps))
    return jnp.ceil((angle - np.pi - margin) / (2 * np.pi))


class Arm(NamedTuple):
    """Three joints and the rigid parts between them, as the closed form sees a linkage.

    Vectors x + iy go from joint to joint, in the frame of the link before the joint at
    their end. A joint's own slide counts as 0.

    - `revolute`: whether the joints turn; `locked`: by how much slides turn [rad].
    - `links`: from the first joint to the second, and on to the third (2,) [m].
    - `angle`, `direction`: of the ground and the three links (4,) [rad], as far as they
      do not depend on the tip's position.
    - `ends`: from the ground to the first joint, and from the third to the tip (2,)
      [m].
    - `place`: indices of the joints in the linkage, None if it has no others.
    - `offset`: what positions have beyond those in the linkage [m or rad].
    - `valid`: zeros (n,), or NaN if another number of joints moves, or none turns.
    """

    revolute: Scalars
    locked: Array
    links: Array
    angle: Array
    direction: Array
    ends: Array
    place: Array | None
    offset: Array | int
    valid: Array

    @property
    def base(self) -> Array:
        """The tip's position without the vector from first joint to last link [m]."""
        return self.ends[0] * self.direction[0] + self.ends[1] * self.direction[3]

    def placed(self, q: Array) -> Array:
        """Returns positions in the linkage (n,), from those of the three joints."""
        if self.place is None:
            return q[: len(self.valid)] + self.valid
        at = jnp.arange(len(self.valid))[:, None] == self.place[None]
        values = q[: len(self.place)] - self.offset
        return jnp.where(at, values[None], 0).sum(axis=1) + self.valid


def check_moving_joints(linkage: Linkage, oriented: bool) -> None:
    """Raises ValueError unless three joints move, or two without an orientation.

    Of traced existence factors only the number is checked.
    """
    wanted, n, traced = 2 + oriented, joints_of(linkage), is_traced(linkage.ef)
    count = n if traced else int(np.asarray(linkage.ef).sum())
    if n < wanted or count != wanted and not traced:
        also = "" if oriented else " where no orientation is commanded"
        got = f"{count} pairs of joints" if traced else count
        cure = "; two need orientation=None (of a TipTask)" if count == 2 else ""
        raise ValueError(
            f"linkage: expected {wanted} joints that move{also}, the others fixed, got "
            f"{got}{cure}."
        )
    if oriented and not traced and not np.any(real_joints(np.asarray(linkage.ef))):
        raise ValueError(
            "linkage: expected a joint that turns where an orientation is commanded, "
            "got slides alone."
        )


def arm_of(linkage: Linkage, orientation: Array | float | None) -> Arm:
    """Returns a linkage as an arm of three joints whose last link has an orientation.

    Without one, two joints move, and a third turns freely at the tip. Positions of
    other arms are NaN.
    """
    oriented, n = orientation is not None, joints_of(linkage)
    check_moving_joints(linkage, oriented)
    wanted = 2 + oriented
    revolute = jnp.stack(real_joints(linkage.ef))
    slide = jnp.where(revolute, linkage.locked, 0)
    if n == wanted:
        vector = plane_vector(linkage.length, jnp.append(slide, 0))
        locked, ground, offset, place = linkage.locked, linkage.base_angle, 0, None
    else:
        # Where the chain is with its joints at 0: what is fixed keeps its shape.
        f = frames(linkage, jnp.zeros_like(linkage.locked))
        place = jnp.argsort(linkage.fixed, stable=True)[:wanted]
        begins, ends = jnp.append(0, place + 1), jnp.append(place, n)
        turned = f.angle[ends] - f.angle[begins]  # within a rigid part
        end = jnp.append(f.start[1:], f.tip(linkage))
        vector = (end[ends] - f.start[begins]) * f.direction[ends].conj()
        revolute = revolute[place]
        locked = linkage.locked[place] + turned[1:]
        ground = f.angle[ends[0]]
        offset = jnp.where(revolute, turned[1:], vector[:-1].imag)
        across = jnp.where(jnp.append(revolute, True), vector.imag, 0)
        vector = plane_vector(vector.real, across)
    if not oriented:
        revolute, locked = jnp.append(revolute, True), jnp.append(locked, locked[0])
        vector = jnp.append(vector, 0)
    r1, _, r3 = revolute
    last = 0.0 if orientation is None else orientation
    from_tip = last - locked[2]
    second = jnp.where(r1, from_tip - locked[1], ground + locked[0])
    third = jnp.where(r3, second + locked[1], from_tip)
    angle = jnp.stack([ground, second, third, last])
    fits = (jnp.sum(linkage.ef) == wanted) & jnp.any(revolute)
    valid = jnp.where(fits, 0, jnp.nan)
    return Arm(
        revolute=tuple(revolute),
        locked=locked,
        links=vector[1:3],
        angle=angle,
        direction=unit_vector(angle),
        ends=vector[::3],
        place=place,
        offset=offset,
        valid=jnp.broadcast_to(valid, n),
    )


def solve_joints(
    arm: Arm, wrist: Array, bearing: Array, branch: Array
) -> tuple[Array, Array, Array]:
    """Computes positions of a linkage (n,) from the wrist x + iy, NaN out of reach.

    Also returns a root, 0 at the edge of the reach, and how far the wrist is beyond the
    edge [m]: negative within reach, infinite for two parallel slides. `bearing`, the
    angle of `wrist`, may be continuous along a path that winds around the pivot.
    """
    # The vectors of links 2 and 3 and the slides add up to the wrist vector. Two of
    # these parts are unknown, in three kinds: two vectors of known lengths (RRR), one
    # vector of known length and one slide of known direction (RRP, PRR, and RPR as seen
    # from link 2, where the wrist vector turns), two slides (PPR, RPP, PRP). The first
    # two kinds need a square root, whose sign is the branch.
    r1, r2, r3 = arm.revolute
    # Which vectors turn by themselves: link 2's, link 3's, or the wrist's as a whole.
    turning2, turning3, whole = r1 & r2, r2 & r3, r1 & r3
    two_turning, framed = whole & r2, whole & ~r2  # RRR, RPR
    two_slides = ~(turning2 | turning3 | whole)
    th1, th2, th3, th4 = arm.angle
    e1, e2, e3, _ = arm.direction

    d = arm.links
    square2, square3 = dot(d, d)
    own2, own3 = plane_angle(d.imag, d.real)

    # What the known vectors leave of the wrist vector, along the directions a and b:
    # the slides run across a and, if there are two, across b.
    turns = jnp.stack([turning2, turning3])
    known = jnp.where(turns, 0, d * arm.direction[1:3]).sum()
    rest = jnp.where(framed, known, wrist - known)
    a = jnp.where(r1, jnp.where(r2, e3, e2), e1)
    b = jnp.where(two_slides, jnp.where(r3, e2, e3), 1j * a)
    span = cross(a, b)  # sine of the angle between two slides
    parallel = jnp.abs(span) <= 16 * np.finfo(span.dtype).eps
    span = jnp.where(parallel, jnp.nan, span)

    # A turning vector is known by its length and its component along a. For two, the
    # same holds of their product, one conjugated, by the law of cosines.
    square = dot(wrist, wrist)
    inner = (square - square2 - square3) / 2
    component = dot(a, rest)
    along = jnp.where(two_turning, inner, component)
    # What is left across a is a root. For two it is that of a product of what is left
    # to both edges of the reach, which are exact where the arm folds.
    length2, length3 = length_of(d)
    longest = jnp.where(turning2, square2, 0) + jnp.where(turning3, square3, 0)
    longest = jnp.where(framed, square, longest)
    longest = jnp.where(two_turning, (length2 + length3) ** 2, longest)
    outer = longest - jnp.where(two_turning, square, component**2)
    outer = jnp.where(two_slides, 1, outer)
    inmost = jnp.where(two_turning, square - (length2 - length3) ** 2, 4)
    # Computed positions of tips are off by less.
    sizes = sum(dot(arm.ends, arm.ends), square2 + square3)
    rounding = 64 * np.finfo(square.dtype).eps * (1 + abs(th4)) * (sizes + square)
    outside = jnp.minimum(outer, inmost) < -rounding
    product = jnp.maximum(outer, 0) * jnp.maximum(inmost, 0) / 4
    root = branch * jnp.sqrt(jnp.where(outside, jnp.nan, product))
    size = jnp.where(two_turning, length_of(wrist), abs(component))
    missing = jnp.maximum(
        size - jnp.sqrt(jnp.where(two_slides, 1, longest)),
        jnp.where(two_turning, abs(length2 - length3) - size, -jnp.inf),
    )
    missing = jnp.where(two_slides, jnp.where(parallel, jnp.inf, -jnp.inf), missing)

    angle = plane_angle(root, along + jnp.where(two_turning, square2, 0))
    second = jnp.where(whole, bearing - angle, jnp.where(turning2, th3 + angle, th2))
    second = second - jnp.where(turning2, own2, 0)
    bend = jnp.where(r2, own2 + plane_angle(root, inner) - own3, arm.locked[1])
    third = jnp.where(
        whole, second + bend, jnp.where(turning3, th1 + angle - own3, th3)
    )
    slide = dot(b, rest) / span - jnp.where(two_slides, 0, root)
    other = jnp.where(two_slides, -component / span, slide)
    turned = second - th1, third - second, th4 - third
    slid = slide, jnp.where(framed, -slide, jnp.where(r1, slide, other)), other
    q = [jnp.where(*joint) for joint in zip(arm.revolute, turned, slid)]
    return arm.placed(jnp.stack(q)), root, missing


def beyond(missing: Array) -> str:
    """Says in messages how far a point or a path is out of reach."""
    farthest = np.asarray(missing).max()
    if farthest == np.inf:
        return ", and two slides that are parallel"
    most = "at most " if np.size(missing) > 1 else ""
    return f", beyond it by {most}{farthest:.3g} m" if farthest > 0 else ""


def inverse_kinematics(
    linkage: Linkage, tip: ArrayLike, orientation: ArrayLike | None, *, branch: int = 1
) -> Float[Array, " joint"]:
    """Computes joint positions for a tip position and a direction of the last link.

    The closed form takes three moving joints, at least one of which turns, or two
    without an orientation. Fixed pairs may be anywhere. The direction from the first
    joint to the last link's start is in (-pi, pi]; the angles follow from it without
    wrapping.

    **Arguments:**

    - `tip`: the point (x, y) [m].
    - `orientation`: th4, the absolute angle of the last link [rad]; None for two
      joints.
    - `branch`: 1 or -1, one of two assemblies. It is the sign of the turn from A2 to A3
      (RRR), of the slide from the foot of the perpendicular (RPR), or of the side of
      the turning vector (PRR, RRP). Two joints count as with a third that turns at the
      tip. Ignored where there is only one assembly.

    **Returns:** `q` (n,) [m or rad], 0 at fixed pairs; NaN for traced arguments if the
    point is out of reach. A point beyond the reach by rounding counts as on its edge,
    where the assemblies meet and derivatives are not finite. Near the edge, a point
    known to 1e-16 m gives joints known to 1e-8 rad.

    **Raises:** ValueError for malformed arguments, another number of moving joints,
    three slides, and a known point out of reach.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> q = fj.inverse_kinematics(arm, tip=[-5, 2], orientation=1.5707963)
    >>> q.tolist(), fj.tip_position(arm, q).tolist()
    ([1.571, 2.5, -1.571], [-5.0, 2.0])
    """
    check_linkage(linkage)
    tip = real_array("tip", tip, (2,))
    if orientation is not None:
        orientation = real_array("orientation", orientation, (), unit="rad")
    check_moving_joints(linkage, orientation is not None)
    side = real_array("branch", branch, ())
    if (sign := concrete(side)) is not None and abs(sign) != 1:
        raise refusal("branch", "1 or -1", branch)
    q, _, missing = _positions(linkage, tip, orientation, side)
    if not (is_traced(q) or np.isfinite(q).all()):
        at = "" if orientation is None else f" at orientation {orientation:g} rad"
        raise ValueError(
            f"tip: expected a point within reach{at}, got {tip.tolist()} m"
            f"{beyond(missing)}."
        )
    return q


@at_once
def _positions(
    linkage: Linkage, tip: Array, orientation: Array | None, branch: Array
) -> tuple[Array, Array, Array]:
    arm = arm_of(linkage, orientation)
    wrist = plane_vector(*tip) - arm.base
    bearing = plane_angle(wrist.imag, wrist.real)
    bearing = bearing - 2 * np.pi * whole_turns(bearing)
    return solve_joints(arm, wrist, bearing, branch)
