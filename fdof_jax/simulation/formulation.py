"""The formulation of a motion: equations, start, reading of states, known times."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ..forces.element import Forces
from ..forces.payload import Payload
from ..linkage.fields import jumps_at
from ..mechanics.equations import Scalars, zeros
from ..steps.dopri8 import Integrated, ScheduledTerm
from ..steps.landing import clearance
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

# By which a clock is ahead of the one before, in units of `clearance`: beyond the
# distances that steps keep from each time.
_AHEAD = 8


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


def clocks_apart(args: Args, ts: Array) -> Args:
    """Returns the arguments with clocks by which no two elements jump at once.

    If times coincided, one step would end at all of them, and derivatives would
    attribute the jumps of all elements to one of them. Each clock is ahead of the one
    before by some units of rounding.
    """
    # A prescribed motion also gives positions, and comes first: it keeps the time.
    motion = prescribed(args.forces)
    places = sorted(
        (element is not motion, place)
        for place, element in enumerate(args.forces)
        if element.jump_ts is not None
    )
    if len(places) < 2:
        return args
    unit = _AHEAD * clearance(ts)
    ahead = [0.0] * len(args.forces)
    for rank, (_, place) in enumerate(places):
        ahead[place] = rank
    return args._replace(ahead=unit * jnp.array(ahead, unit.dtype))


def clear_of_start(forces: Forces, ts: Array) -> Array:
    """Returns the time after a start [s] at which another element's jump counts.

    The clock of that element is ahead of those of `forces`.
    """
    timed = sum(element.jump_ts is not None for element in forces)
    return (1 + _AHEAD * timed) * clearance(ts)


def known_times(args: Args) -> Array | None:
    """Returns the times [s] at which elements jump by their clocks, or None."""
    times = [jumps_at(f"forces[{k}]", e) for k, e in enumerate(args.forces)]
    ahead = [0] * len(times) if args.ahead is None else args.ahead
    times = [t - by for t, by in zip(times, ahead) if t is not None]
    return jnp.concatenate(times) if times else None
