"""The formulation of a motion: equations, start, reading of states, known times."""

import dataclasses

import jax.numpy as jnp
from jax import Array

from ..forces.element import Forces
from ..linkage.fields import jumps_at
from ..mechanics.equations import Scalars, zeros
from ..steps.dopri8 import Integrated, ScheduledTerm
from ..steps.landing import clearance
from .events import resolve
from .field import (
    Args,
    health_of,
    schedule_of,
    switching,
    vector_field,
    watched_field,
    whole,
    with_prescribed_rates,
)
from .holding import changes, guarded_switching, unknown_modes
from .prescribed import prescribed

# By which a clock is ahead of the one before, in units of `clearance`: beyond the
# distances that steps keep from each time.
_AHEAD = 8


_DRIVEN = ScheduledTerm(vector_field, schedule_of, health_of, watched_field, switching)
_HOLDING = ScheduledTerm(
    vector_field, schedule_of, health_of, watched_field,
    guarded_switching, unknown_modes, resolve,
)  # fmt: skip
# Terms are made once, so that their functions are traced once.
_TERMS = {
    (holds, follows): dataclasses.replace(
        _HOLDING if holds else _DRIVEN,
        settle=with_prescribed_rates if follows else None,
    )
    for holds in (False, True)
    for follows in (False, True)
}


def term_of(forces: Forces) -> ScheduledTerm:
    """Returns the equations of a motion."""
    return _TERMS[changes(forces), prescribed(forces) is not None]


def start_of(args: Args, qd: Array, own: Scalars) -> Integrated:
    """Returns the integrated state at the start, before any jump there."""
    return whole(zeros(args.q0), tuple(qd), own)


def joints_at(args: Args, t: Array, y: Integrated) -> tuple[Array, Array]:
    """Returns joint positions and velocities at an integrated state."""
    q, qd = args.q0 + jnp.stack(y[0]), jnp.stack(y[1])
    if (motion := prescribed(args.forces)) is None:
        return q, qd
    moved, at = motion.prescribes(args.linkage), motion.at(t, args.linkage)
    q, qd = (jnp.where(moved, *pair) for pair in zip(at, (q, qd)))
    return q, qd


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
