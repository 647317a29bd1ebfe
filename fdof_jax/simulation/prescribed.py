"""Hybrid dynamics: some joints follow a prescribed motion, the others are driven.

H are the prescribed joints, F the others:

    M_FF qdd_F = tau_F - b_F - M_FH qdd_H

Where a prescribed velocity jumps, so do the others: M_FF dqd_F = -M_FH dqd_H. Each step
begins with this correction; without a jump it is hardly more than rounding.
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
from ..forces.added_inertia import present
from ..forces.element import Element, Forces, naming
from ..linkage.fields import Truth, called
from ..linkage.joint_numbers import among_joints, numbered, numbers_in
from ..linkage.linkage import Linkage, joints_of
from ..references.reference import EXPECTED, reference_motion


class PrescribedMotion(Element):
    """Joints that follow a reference exactly, whatever effort that takes.

    Where the reference's velocity jumps, an impulse makes the velocities of other
    joints jump too. If `state0` has other velocities than the reference, the motion
    starts with such an impulse, and its first velocities are those after it.
    `joint_efforts` returns the effort [N or N m] without impulses.

    Friction at a prescribed joint adds to its effort but is not counted in
    `Solution.taken`. Stops and brakes there are rejected.

    **Arguments:**

    - `joints`: the number of a prescribed joint, from 1, or several.
    - `reference`: `(t, linkage) -> (q, qd)`, as for a `PDController`; values for other
      joints are ignored. The positions are continuous and start at those of `state0`;
      the velocities are their rates.

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
        """Returns whether each joint is prescribed; a fixed pair is not."""
        return self.moved[: joints_of(linkage)] & ~linkage.fixed

    def at(self, t: Array, linkage: Linkage) -> tuple[Array, Array]:
        return reference_motion(self.reference, t, linkage)

    def conditions_on(self, linkage):
        yield among_joints(self.moved, linkage)

    def schedule(self, t: Array, linkage: Linkage) -> tuple[Array, Array, Array]:
        """Returns positions, velocities and accelerations (n,) at a time."""
        at, now = lambda t: self.at(t, linkage), jnp.asarray(t)
        (q, qd), (_, qdd) = jax.jvp(at, (now,), (jnp.ones_like(now),))
        return q, qd, qdd

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        return jnp.zeros_like(q)  # the real efforts depend on all other elements


def prescribed(forces: Forces) -> PrescribedMotion | None:
    motions = [e for e in forces if isinstance(e, PrescribedMotion)]
    if len(motions) > 1:
        raise refusal("forces", "one PrescribedMotion at most", len(motions))
    return motions[0] if motions else None


def agrees(forces: Forces, t: Array, q: Array, linkage: Linkage) -> Truth:
    """Returns whether prescribed joints are at the reference, to 1e-6."""
    if (motion := prescribed(forces)) is None:
        return True
    with naming(f"forces[{place_of(motion, forces)}]"):
        begin, _ = motion.at(t, linkage)
    near = abs(q - begin) <= 1e-6 * (1 + abs(begin))
    return (near | ~motion.prescribes(linkage)).all()


def prescribed_effort(
    linkage: Linkage, forces: Forces, t: Array, q: Array, qd: Array, tau: Array
) -> Float[Array, " joint"]:
    """Computes the effort of the prescribed motion beside other efforts `tau`."""
    motion = prescribed(forces)
    assert motion is not None
    matrix, bias = mass_and_bias(linkage, present(forces, t), q, qd)
    moved, (*_, qdd) = motion.prescribes(linkage), motion.schedule(t, linkage)
    given = jnp.where(moved, qdd, 0)
    free = jnp.where(jnp.outer(~moved, ~moved), matrix, jnp.eye(len(moved)))
    net = jnp.where(moved, qdd, tau - bias - matrix @ given)
    qdd = jnp.linalg.solve(free, net)
    return jnp.where(moved, matrix @ qdd + bias - tau, 0)
