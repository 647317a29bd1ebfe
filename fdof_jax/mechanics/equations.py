"""The reduced equations of motion of a chain of joints, in scalars.

For three joints they are S(EF)^T M S(EF) of the paper's six.
"""

import dataclasses
from collections.abc import Callable
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from ..base.checks import concrete
from ..base.trigonometry import sincos
from ..linkage.linkage import Linkage
from ..linkage.topology import fixed_pairs, real_joints

# Scalars, because XLA on CPU computes a stacked result once per entry. Positions are
# displacements from a reference, whose directions they turn: a pendulum 1e-17 rad away
# from upright keeps that angle, and an arm that starts after a million turns moves as
# before. The algebra is a composite-body recursion from the tip. Existence factors
# select between turning about a point and sliding along a direction; at a fixed pair,
# displacement and rate are zero.

Scalars = tuple[Array, ...]
Vector = tuple[Array, Array]
Directions = tuple[Vector, ...]
# The upper triangle of a symmetric matrix: row i holds the entries from (i, i) on.
Upper = tuple[tuple[Array, ...], ...]


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Known:
    """A flag that is part of a program instead of one of its arrays."""

    holds: bool


Flag = Array | Known


def where(flag: Flag, a: Any, b: Any) -> Any:
    """Selects as `jnp.where` does; if the flag is known, `a` or `b` itself."""
    if isinstance(flag, Known):
        return a if flag.holds else b
    return jnp.where(flag, a, b)


class Constants(NamedTuple):
    """Scalars of a linkage for the equations, computed once per solve.

    Each tuple has an entry per pair of joints, k, or per link that follows. Flags are
    `Known` where a program contains them.

    - `revolute`, `fixed`: whether the pair turns; whether it neither turns nor slides.
    - `direction`: of the ground and of each link at the reference.
    - `slide`: B_k at the reference [m].
    - `carried`: mass of the link and all beyond [kg].
    - `along`: from the link's start to the next slide [m]; none for the last.
    - `moment`: first moment along and across the link [kg m], with the mass beyond at
      the end of `along`; `second`: second moment about the link's start [kg m^2].
    - `ends_in_slides`: whether the pair slides and one pair beyond it moves, a slide.
    - `slide_pivot`: inertia [kg] of the first of these slides with the other free: m3 +
      m4 sin^2 of the angle between them, as m34 - m4 cos^2 would cancel.
    """

    revolute: tuple[Flag, ...]
    fixed: tuple[Flag, ...]
    direction: Directions
    slide: Scalars
    gravity: Array
    carried: Scalars
    along: Scalars
    moment: tuple[Vector, ...]
    second: Scalars
    ends_in_slides: tuple[Flag, ...]
    slide_pivot: Scalars


def link_constants(
    linkage: Linkage,
    q: Float[Array, " joint"],
    sincos: Callable[[Array], tuple[Array, Array]] = sincos,
) -> Constants:
    """Computes the scalars that `rates` needs, with `q` as reference."""
    revolute, fixed, ends_in_slides = _flags(linkage.ef)
    turns = jnp.stack(real_joints(linkage.ef))
    q = jnp.where(linkage.fixed, 0, q)
    angle = jnp.where(turns, q, linkage.locked)
    sin, cos = sincos(jnp.concatenate([linkage.base_angle[None], angle]))
    ground, *turned = zip(cos, sin)
    # Directions are combined, because a sum of large angles is rounded.
    direction = [ground]
    for turn in turned:
        direction.append(_in_frame(*turn, direction[-1]))
    last = len(turned) - 1
    along, mass = tuple(linkage.length[1:-1]), tuple(linkage.mass)
    carried = list(mass)
    for k in reversed(range(last)):
        carried[k] = carried[k] + carried[k + 1]
    (*moment,) = zip(*(linkage.mass[:, None] * linkage.com).T)
    own = linkage.inertia + linkage.mass * jnp.sum(linkage.com**2, axis=1)
    (*second,) = own
    for k in range(last):
        moment[k] = (moment[k][0] + carried[k + 1] * along[k], moment[k][1])
        second[k] = second[k] + carried[k + 1] * along[k] ** 2
    return Constants(
        revolute=revolute,
        fixed=fixed,
        direction=tuple(direction),
        slide=tuple(jnp.where(turns, linkage.locked, q)),
        gravity=linkage.gravity,
        carried=tuple(carried),
        along=along,
        moment=tuple(moment),
        second=tuple(second),
        ends_in_slides=ends_in_slides,
        slide_pivot=_slide_pivots(fixed, mass, turned),
    )


def _flags(ef: Array | np.ndarray) -> tuple[tuple[Flag, ...], ...]:
    """Returns `revolute`, `fixed` and `ends_in_slides`, known if `ef` is."""
    known = concrete(ef)
    factors = ef if known is None else known
    revolute, fixed = real_joints(factors), fixed_pairs(factors)
    last = len(fixed) - 1
    slides = [~turns & ~rests for turns, rests in zip(revolute, fixed)]
    ends = []
    # Of the pairs beyond: whether none moves; whether one does, a slide.
    none, one_slide = fixed[last], slides[last]
    for k in reversed(range(last)):
        ends.append(one_slide & slides[k])
        one_slide = fixed[k] & one_slide | none & slides[k]
        none = none & fixed[k]
    flags = revolute, fixed, tuple(ends[::-1])
    if known is None:
        return flags
    return tuple(tuple(Known(bool(holds)) for holds in row) for row in flags)


def with_held(c: Constants, held: Scalars) -> Constants:
    """Returns the constants with held joints as fixed pairs."""
    either = lambda pair, own: where(pair, jnp.ones_like(own), own)
    ends = list(c.ends_in_slides)
    # A slide whose one slide beyond is held has the pivot of a single one.
    for k in range(len(ends)):
        for own in held[k + 1 :]:
            ends[k] = where(ends[k], ~own, jnp.zeros_like(own))
    return c._replace(
        fixed=tuple(map(either, c.fixed, held)), ends_in_slides=tuple(ends)
    )


def _slide_pivots(
    fixed: tuple[Flag, ...], mass: Scalars, turned: list[Vector]
) -> Scalars:
    """Returns `slide_pivot` of all pairs but the last."""
    last = len(mass) - 1
    pivots = []
    # The mass that the next pair to move carries, the mass before it, and its direction
    # as seen here.
    carried, before, turn = mass[last], jnp.zeros_like(mass[last]), turned[last]
    for k in reversed(range(last)):
        turn = _select(fixed[k + 1], _in_frame(*turned[k], turn), turned[k])
        before = mass[k] + where(fixed[k + 1], before, 0)
        pivots.append(before + carried * turn[1] ** 2)
        carried = where(fixed[k], carried, before + carried)
    return tuple(pivots[::-1])


def _cross(u: Vector, v: Vector) -> Array:
    return u[0] * v[1] - u[1] * v[0]


def _dot(u: Vector, v: Vector) -> Array:
    return u[0] * v[0] + u[1] * v[1]


def _add(u: Vector, v: Vector) -> Vector:
    return u[0] + v[0], u[1] + v[1]


def _scale(factor: Array, u: Vector) -> Vector:
    return factor * u[0], factor * u[1]


def _in_frame(along: Array, across: Array, e: Vector) -> Vector:
    return along * e[0] - across * e[1], along * e[1] + across * e[0]


def _select(flag: Flag, u: Vector, v: Vector) -> Vector:
    return where(flag, u[0], v[0]), where(flag, u[1], v[1])


def turns(c: Constants, delta: Scalars) -> Scalars:
    """Computes the angles by which displacements turn the links [rad]."""
    zero = jnp.zeros_like(delta[0])
    turned = [where(r, step, zero) for r, step in zip(c.revolute, delta)]
    return tuple(accumulate(turned))


def directions(c: Constants, delta: Scalars) -> Directions:
    """Computes the unit vectors along the links, turned by displacements."""
    both = (sincos(angle, inlined=True) for angle in turns(c, delta))
    return tuple(_in_frame(cos, sin, e) for (sin, cos), e in zip(both, c.direction[1:]))


class Equations(NamedTuple):
    """M qdd + bias = tau, with M symmetric (kg m^2, kg m or kg by joint types)."""

    mass: Upper
    bias: Scalars


def equations(
    c: Constants, delta: Scalars, qd: Scalars, turned: Directions | None = None
) -> Equations:
    """Computes the equations of motion: (8)-(13) projected on the real joints.

    `turned`: the `directions` at `delta`, if the caller has them.
    """
    r, joints, last = c.revolute, range(len(delta)), len(delta) - 1
    zero = jnp.zeros_like(delta[0])
    # Joint k turns about the start of its link, or slides across the link before, along
    # i e[k].
    e = c.direction[0], *(directions(c, delta) if turned is None else turned)
    slide = [c.slide[k] + where(r[k], zero, delta[k]) for k in joints]
    step = [_in_frame(c.along[k], slide[k + 1], e[k + 1]) for k in joints[:-1]]
    w = list(accumulate([where(r[k], qd[k], zero) for k in joints]))
    w2 = [rate * rate for rate in w]

    # While all joints keep their rates: accelerations of the links' starts, from the
    # base outwards, upwards by gravity. A joint's rate adds w_k^2 - w_(k-1)^2 to the
    # angular velocity squared, or half of it as the Coriolis acceleration of a slide.
    # Differences of nearly equal squares would cancel; these products do not.
    gained = [None, *(qd[k] * (w[k - 1] + w[k]) for k in joints[1:])]
    coriolis = [None, *(where(r[k], zero, gained[k]) for k in joints[1:])]
    start = [(jnp.zeros_like(c.gravity), c.gravity)]

    def across_start(u: Vector, k: int) -> Array:
        return u[0] * c.gravity if k == 0 else _cross(u, start[k])

    for k in joints[:-1]:
        inward = _add(_scale(w2[k], step[k]), _scale(coriolis[k + 1], e[k + 1]))
        start.append((start[k][0] - inward[0], start[k][1] - inward[1]))

    # From the tip inwards, of all that is beyond a joint: its moments `first` and
    # `second` about the joint, the `force` and `moment` that bend its path from a
    # rotation with the joint, and -i times its `momentum` at unit rate of the joint.
    first, second = _in_frame(*c.moment[last], e[last + 1]), c.second[last]
    force: Vector | None = None
    moment: Any = None
    momentum: Any = None
    rows, bias = [], []
    for k in reversed(joints):
        if k < last:
            mass_slide = c.carried[k + 1] * slide[k + 1]
            more = _scale(gained[k + 1], momentum)
            force = more if force is None else _add(force, more)
            bent = _cross(step[k], force) + coriolis[k + 1] * _cross(first, e[k + 1])
            moment = bent if moment is None else moment + bent
            own = c.second[k] + mass_slide * slide[k + 1]
            second = own + 2 * _dot(step[k], first) + second
            along, across = c.moment[k]
            first = _add(_in_frame(along, across + mass_slide, e[k + 1]), first)
        # The moment about the joint (revolute), or the force along it (prismatic).
        turning, thrown = across_start(first, k), _scale(w2[k], first)
        if force is not None:
            turning, thrown = turning - moment, _add(thrown, force)
        lift = across_start(e[k], max(k - 1, 0))
        if k > 0:
            lift = lift - w2[k - 1] * slide[k]
        sliding = c.carried[k] * lift - _cross(e[k], thrown)
        bias.append(where(r[k], turning, sliding))
        # Joint k at unit rate: each joint before it takes a share of the momentum.
        momentum = _select(r[k], first, _scale(c.carried[k], e[k]))
        angular = where(r[k], second, _dot(first, e[k]))
        column = [where(r[k], second, c.carried[k])]
        for i in reversed(joints[:k]):
            angular = angular + _dot(step[i], momentum)
            column.append(where(r[i], angular, _dot(e[i], momentum)))
        rows.append(column[::-1])  # entries (0, k) to (k, k)
    columns = rows[::-1]
    mass = tuple(tuple(columns[j][i] for j in joints[i:]) for i in joints)
    return Equations(mass, tuple(bias[::-1]))


def zeros(q: Float[Array, " joint"] | Scalars) -> Scalars:
    """Returns zero displacements, rates or efforts in the dtype of `q`."""
    return (jnp.zeros_like(q[0]),) * len(q)
