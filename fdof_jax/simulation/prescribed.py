"""Hybrid dynamics: some joints follow a prescribed motion, the others are driven.

The state holds the momenta of the driven joints instead of their velocities, because
momenta are continuous where a prescribed velocity jumps.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from ..base.checks import place_of, refusal
from ..dynamics import mass_and_bias
from ..forces.element import Element, Forces, naming
from ..forces.holders import among_joints, numbered, numbers_in
from ..linkage.fields import Truth, called
from ..linkage.linkage import Linkage, joints_of, without_fixed
from ..linkage.topology import fixed_pairs
from ..mechanics.equations import Scalars, equations, zeros
from ..references.reference import EXPECTED, reference_motion
from ..steps.dopri8 import Health, Integrated
from .field import Args, applied, health_at, health_with, switching, whole


class PrescribedMotion(Element):
    """Joints that follow a reference exactly, whatever effort that takes.

    Where the reference's velocity jumps, an impulse makes the velocities of the other
    joints jump too. `joint_efforts` returns the effort [N or N m] without impulses,
    among its `elements`.

    The velocities of `state0` are those before the first time. If they differ from the
    reference's, the motion starts with an impulse, and its first velocities are those
    after it. Adaptive steps control the errors of the other joints' displacements and
    momenta.

    **Arguments:**

    - `joints`: the number of a prescribed joint, from 1, or several such numbers.
    - `reference`: `(t, linkage) -> (q, qd)`, as for a `PDController`; values for other
      joints and for fixed pairs are ignored. The positions must be continuous and equal
      those of `state0` at the start of a simulation; the velocities must be their
      rates.

    **Raises:** ValueError for malformed arguments.
    """

    moved: Bool[Array, " number"]
    reference: Callable = called(EXPECTED)

    def __init__(self, joints: ArrayLike | Sequence[int], reference: Callable):
        self.moved = numbered(joints)
        self.reference = reference

    def arguments(self) -> dict[str, Any]:
        return {"joints": numbers_in(self.moved), "reference": self.reference}

    def prescribes(self, linkage: Linkage) -> Array:
        """Returns whether each joint of an arm is prescribed; a fixed pair is not."""
        fixed = jnp.stack(fixed_pairs(linkage.ef))
        return self.moved[: joints_of(linkage)] & ~fixed

    def at(self, t: Array, linkage: Linkage) -> tuple[Array, Array]:
        return reference_motion(self.reference, t, linkage)

    def conditions_on(self, linkage):
        yield among_joints(self.moved, linkage)

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        return jnp.zeros_like(q)  # the real efforts depend on all other elements


def prescribed(forces: Forces) -> PrescribedMotion | None:
    """Returns the `PrescribedMotion` among the elements, or None."""
    motions = [e for e in forces if isinstance(e, PrescribedMotion)]
    if len(motions) > 1:
        raise refusal("forces", "one PrescribedMotion at most", len(motions))
    return motions[0] if motions else None


def agrees(forces: Forces, t: Array, q: Array, linkage: Linkage) -> Truth:
    """Returns whether prescribed joints are at the reference, to 1 in a million."""
    if (motion := prescribed(forces)) is None:
        return True
    with naming(f"forces[{place_of(motion, forces)}]"):
        begin, _ = motion.at(t, linkage)
    near = abs(q - begin) <= 1e-6 * (1 + abs(begin))
    return (near | ~motion.prescribes(linkage)).all()


def _mass_matrix(args: Args, q: Array) -> Array:
    start, still = (args.q0, args.constants), jnp.zeros_like(q)
    return mass_and_bias(args.linkage, args.forces, q, still, start)[0]


def _of_driven(moved: Array, matrix: Array) -> Array:
    """Returns the matrix, with the rows and columns of prescribed joints as in 1."""
    return jnp.where(jnp.outer(~moved, ~moved), matrix, jnp.eye(len(moved)))


def _split(moved: Array, matrix: Array, given: Array, right: Array) -> Array:
    """Solves the rows of the driven joints, given those of the prescribed ones."""
    given = jnp.where(moved, given, 0)
    right = jnp.where(moved, given, right - matrix @ given)
    return jnp.linalg.solve(_of_driven(moved, matrix), right)


def hybrid_joints(args: Args, t: Array, y: Integrated) -> tuple[Array, Array]:
    displaced, momenta, *_ = y
    q, momenta = args.q0 + jnp.stack(displaced), jnp.stack(momenta)
    moved, motion = _moved(args), _motion(args.forces)
    position, velocity = motion.at(t, args.linkage)
    q = jnp.where(moved, position, q)
    return q, _split(moved, _mass_matrix(args, q), velocity, momenta)


def hybrid_start(args: Args, qd: Array) -> tuple[Scalars, Scalars]:
    momenta = jnp.where(_moved(args), 0, _mass_matrix(args, args.q0) @ qd)
    return zeros(args.q0), tuple(momenta)


def _motion(forces: Forces) -> PrescribedMotion:
    motion = prescribed(forces)
    assert motion is not None  # hybrid dynamics are of no other motions
    return motion


def _moved(args: Args) -> Array:
    """Returns whether each joint is prescribed."""
    return _motion(args.forces).prescribes(args.linkage)


def hybrid_switching(t, y, args, schedule) -> tuple[Array, tuple[bool, ...]]:
    q, qd = hybrid_joints(args, t, y)
    return switching(t, (tuple(q - args.q0), tuple(qd), *y[2:]), args, schedule)


def hybrid_field(t, y, args, schedule) -> Integrated:
    """Rates of displacements and momenta, 0 at prescribed joints.

    The rate of the momenta is M' qd - bias + tau, where M' is the mass matrix's rate.
    """
    moved, (q, qd) = _moved(args), hybrid_joints(args, t, y)
    displaced = tuple(q - args.q0), tuple(qd)
    tau, own_rates, *_ = applied(t, (*displaced, *y[2:]), args, schedule)
    # The efforts already include the bias of masses that elements move.
    bias = jnp.stack(equations(args.constants, *displaced).bias)
    momenta = lambda q: _mass_matrix(args, q) @ qd
    _, change = jax.jvp(momenta, (q,), (qd,))
    change = without_fixed(args.linkage, change - bias + jnp.stack(tau))
    driven = jnp.where(moved, 0, change)
    return whole(tuple(jnp.where(moved, 0, qd)), tuple(driven), own_rates)


def watched_hybrid_field(t, y, args, schedule) -> tuple[Integrated, Health]:
    """Rates of `hybrid_field` and their health, as in `field.watched_field`."""
    rates = hybrid_field(t, y, args, schedule)
    return rates, health_with(rates, hybrid_health(t, y, args))


def hybrid_health(t, y, args) -> Health:
    """Health of the driven joints' equations, as in `field.health_of`."""
    q, _ = hybrid_joints(args, t, y)
    free = _of_driven(_moved(args), _mass_matrix(args, q))
    losses = jnp.diag(free) * jnp.diag(jnp.linalg.inv(free))
    return health_at(tuple(jnp.where(losses > 0, losses, jnp.inf)))


def prescribed_effort(
    linkage: Linkage, forces: Forces, t: Array, q: Array, qd: Array, tau: Array
) -> Float[Array, " joint"]:
    """Computes the effort of the prescribed motion beside other efforts `tau`."""
    motion = _motion(forces)
    matrix, bias = mass_and_bias(linkage, forces, q, qd)
    velocity = lambda t: motion.at(t, linkage)[1]
    _, demanded = jax.jvp(velocity, (t,), (jnp.ones_like(t),))
    moved = motion.prescribes(linkage)
    qdd = _split(moved, matrix, demanded, tau - bias)
    return jnp.where(moved, matrix @ qdd + bias - tau, 0)
