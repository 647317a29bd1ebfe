"""The formulation of a motion: its equations, their start and how states are read."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ..forces.element import Forces
from ..forces.payload import Payload
from ..mechanics.equations import Scalars, zeros
from ..steps.dopri8 import Integrated, ScheduledTerm
from .events import resolve
from .field import Args, health_of, schedule_of, switching, vector_field, watched_field
from .holding import changes, guarded_switching, unknown_modes
from .prescribed import (
    hybrid_field,
    hybrid_health,
    hybrid_joints,
    hybrid_start,
    hybrid_switching,
    prescribed,
    watched_hybrid_field,
)


class Formulation(NamedTuple):
    """The equations of a motion, their start, and the reading of joint states.

    - `term`: the equations.
    - `start(args, qd)`: displacements, and velocities or momenta, at the start, before
      any jump there.
    - `joints(args, t, y)`: joint positions and velocities at an integrated state.
    """

    term: ScheduledTerm
    start: Callable[[Args, Array], tuple[Scalars, Scalars]]
    joints: Callable[[Args, Array, Integrated], tuple[Array, Array]]


def formulation(forces: Forces) -> Formulation:
    """Returns that of velocities or, with a prescribed motion, of momenta."""
    if prescribed(forces) is None:
        return HOLDING if changes(forces) else DRIVEN
    # Momenta would have to jump where a mass is let go, too.
    timed = any(isinstance(e, Payload) and e.jump_ts is not None for e in forces)
    if changes(forces) or timed:
        raise ValueError(
            "forces: expected no element that holds joints (JointFriction without "
            "speed, HardStops, Brake), and no Payload with begin or end, beside a "
            "PrescribedMotion, got both."
        )
    return HYBRID


def _joints(args: Args, t: Array, y: Integrated) -> tuple[Array, Array]:
    return args.q0 + jnp.stack(y[0]), jnp.stack(y[1])


DRIVEN = Formulation(
    ScheduledTerm(vector_field, schedule_of, health_of, watched_field, switching),
    lambda args, qd: (zeros(args.q0), tuple(qd)),
    _joints,
)
HOLDING = DRIVEN._replace(
    term=ScheduledTerm(
        vector_field, schedule_of, health_of, watched_field,
        guarded_switching, unknown_modes, resolve,
    )
)  # fmt: skip
HYBRID = Formulation(
    ScheduledTerm(
        hybrid_field, schedule_of, hybrid_health, watched_hybrid_field, hybrid_switching
    ),
    hybrid_start,
    hybrid_joints,
)
