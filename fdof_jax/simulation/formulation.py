"""The formulation of a motion: equations, start, reading of states, known times."""

import dataclasses
import functools

import jax.numpy as jnp
from jax import Array

from ..base.checks import place_of
from ..forces.element import Forces
from ..linkage.fields import Truth, jumps_at
from ..mechanics.equations import Scalars, zeros
from ..steps.landing import Clock, clearance
from ..steps.term import Integrated, ScheduledTerm
from .events import resolve
from .holding import changes, guarded_switching, unknown_modes
from .prescribed import prescribed
from .sampler import ClockElement, SampleState, after_samples, sampler_of
from .vector_field import (
    Args,
    health_of,
    schedule_of,
    switching,
    vector_field,
    watched_field,
    whole,
    with_prescribed_rates,
)

# By which a clock is ahead of the one before, in units of `clearance`: beyond the
# distances that steps keep from each time.
_LEAD = 8


_DRIVEN = ScheduledTerm(vector_field, schedule_of, health_of, watched_field, switching)
_HOLDING = ScheduledTerm(
    vector_field, schedule_of, health_of, watched_field,
    guarded_switching, unknown_modes, resolve,
)  # fmt: skip


def term_of(forces: Forces) -> ScheduledTerm:
    follows, samples = prescribed(forces) is not None, sampler_of(forces) is not None
    return _term(changes(forces), follows, samples)


@functools.cache  # so that the functions of a term are traced once
def _term(holds: bool, follows: bool, samples: bool) -> ScheduledTerm:
    return dataclasses.replace(
        _HOLDING if holds else _DRIVEN,
        settle=with_prescribed_rates if follows else None,
        sample=_after_samples if samples else None,
    )


def _after_samples(t: Array, y: Integrated, args: Args) -> tuple[SampleState, Truth]:
    """Returns `Args.sampled` where a step begins, and whether it changed there."""
    sampler = sampler_of(args.forces)
    assert sampler is not None
    place = place_of(sampler, args.forces)
    clocks = args.clock(place - 1, t), args.clock(place, t)
    at = *joints_at(args, t, y), args.linkage
    return after_samples(sampler, clocks, *at, args.sampled)


def start_of(args: Args, qd: Array, own: Scalars) -> Integrated:
    """Returns the integrated state at the start, before any jump there."""
    return whole(zeros(args.q0), tuple(qd), own)


def joints_at(args: Args, t: Array, y: Integrated) -> tuple[Array, Array]:
    q, qd = args.q0 + jnp.stack(y[0]), jnp.stack(y[1])
    if (motion := prescribed(args.forces)) is None:
        return q, qd
    moved, at = motion.prescribes(args.linkage), motion.at(t, args.linkage)
    q, qd = (jnp.where(moved, *pair) for pair in zip(at, (q, qd)))
    return q, qd


def clocks_apart(args: Args, ts: Array) -> Args:
    """Returns the arguments with clocks by which no two elements jump at once.

    Otherwise derivatives would attribute all jumps to one element. Each clock is ahead
    of the one before by some units of rounding. A controller's are behind all others,
    because it measures what is left of an impact.
    """
    # A prescribed motion also gives positions, and comes first: it keeps the time.
    motion = prescribed(args.forces)
    elements = [*enumerate(args.forces)]
    others = sorted(
        (element is not motion, place)
        for place, element in elements
        if element.jump_ts is not None
    )
    clocks = [k for k, element in elements if isinstance(element, ClockElement)]
    if len(others) + len(clocks) < 2:
        return args
    unit = _LEAD * clearance(ts)
    lead = [0.0] * len(elements)
    for rank, (_, place) in enumerate(others):
        lead[place] = rank
    for rank, place in enumerate(clocks):
        lead[place] = rank - len(clocks)
    return args._replace(lead=unit * jnp.array(lead, unit.dtype))


def known_times(args: Args) -> tuple[Array | None, tuple[Clock, ...]]:
    """Returns the times [s] at which elements jump, None without any, and clocks."""
    times, clocks = [], []
    for index, element in enumerate(args.forces):
        lead = 0 if args.lead is None else args.lead[index]
        if isinstance(element, ClockElement):
            clock = element.clock
            clocks.append(clock._replace(first=clock.first - lead))
        elif (jumps := jumps_at(f"forces[{index}]", element)) is not None:
            times.append(jumps - lead)
    return jnp.concatenate(times) if times else None, tuple(clocks)
