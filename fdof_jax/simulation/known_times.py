"""Known times at which elements jump, told apart where they coincide."""

import jax.numpy as jnp
from jax import Array

from ..forces.element import Element, Forces
from ..linkage.fields import jumps_of
from ..steps.landing import clearance
from .field import Args
from .prescribed import PrescribedMotion

# By which a clock is ahead of the one before, in units of `clearance`: beyond the
# distances that steps keep from each time.
_AHEAD = 8


def clocks_apart(args: Args, ts: Array) -> Args:
    """Returns the arguments with clocks by which no two elements jump at once.

    If times coincided, one step would end at all of them, and derivatives would
    attribute the jumps of all elements to one of them. Each clock is ahead of the one
    before by some units of rounding.
    """
    # A prescribed motion also gives positions, and comes first: it keeps the time.
    places = sorted(
        (not isinstance(element, PrescribedMotion), place)
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


def known_times(
    args: Args, without: tuple[type[Element], ...] | type[Element] = ()
) -> Array | None:
    """Returns the times [s] at which elements jump by their clocks, or None.

    `without`: kinds of elements whose times do not count.
    """
    places = [i for i, e in enumerate(args.forces) if not isinstance(e, without)]
    if args.ahead is None:
        return jumps_of(*(args.forces[place] for place in places))
    times = [(args.forces[i].jump_ts, args.ahead[i]) for i in places]
    return jnp.concatenate([jnp.ravel(t) - by for t, by in times if t is not None])
