"""Ends of steps at known times and where elements switch."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import Array

from ..base.trees import constant
from ..linkage.fields import has_come

# More than `_MOST_CROSSINGS` count as chatter if all come within the least distance
# between two times, times this power of the unit of rounding (3e5 in float64). Chatter
# soon crosses at that distance; joints that bounce to rest, in however long a run, or
# that throw each other at their stops, are slower. Nothing stops what resets ever
# faster, so that more of them follow each other in a longer time: in a run of one
# second 1e-4 s.
_MOST_CROSSINGS = 100
_PACE, _RESET_PACE = -0.35, -0.7
# After so many tries the switching function itself is taken to jump, and the jump is
# located by halving the step.
_MOST_TRIES = 6
# A step ends so many units of rounding before a known time, and the next one starts as
# many after it, so that rounding within steps does not pass it.
_APART = 4
# A step that would end within this share of its length before a known time ends at it.
_JUST_BEFORE = 1e-6
# A step that would end within so many units of rounding of the end of the run ends
# there: dense output of a shorter one would be rounding alone.
NEAR_END = 100
# Steps that end where something happens stay away from the end by twice as much. A run
# that goes on after a jump at its end is longer by more, by so many clearances.
_LONGER = 64


def clearance(ts: Array) -> Array:
    """Returns the distance kept from known times in a run over the times `ts`.

    It is relative to the largest of them, as rounding affects even a known time of 0.
    """
    return _APART * jnp.finfo(ts.dtype).eps * constant(jnp.max(jnp.abs(ts)))


def _last(end: Array) -> Array:
    """Returns the time after which a step's end may be moved to that of the run."""
    return constant(end - 2 * NEAR_END * jnp.finfo(end.dtype).eps * jnp.abs(end))


class Clock(NamedTuple):
    """Known times that recur: `first` + k `period` for k from 0 to `number` - 1 [s]."""

    first: Array
    period: Array
    number: Array

    def at(self, k: Array) -> Array:
        return self.first + k * self.period

    def near(self, t: Array) -> Array:
        """Returns a few of the times, the next one after `t` among them."""
        now, first, period = constant((t, self.first, self.period))
        k = jnp.maximum(jnp.floor((now - first) / period), 0) + jnp.arange(3)
        return jnp.where(k < self.number, self.at(k), -jnp.inf)


class Found(NamedTuple):
    """Findings in a step: where it should end.

    - `until`: when the step should have ended [s]; its end if nothing switched before.
    - `unseen`: a time before which a function may have passed 0 unseen [s]; else the
      end.
    - `soon`: the time of a switch that follows soon after the end [s]; else the end.
    - `near`: how far from its zero a function may switch [s].
    - `switched`: whether any switches at the end; `resets`: whether any resets the
      state, None if none can.
    """

    until: Array
    unseen: Array
    soon: Array
    near: Array
    switched: Array
    resets: Array | None


class NextStep(NamedTuple):
    """The answer of a controller after a step, without its state."""

    keep: Array
    t0: Array
    t1: Array
    jumped: Array | bool
    result: diffrax.RESULTS


class LandingState(NamedTuple):
    target: Array  # where this step is to end, infinity if anywhere
    gap: Array  # time left out after it, 0 unless it ends at a known time
    resumed: Array  # length of the step after it
    overshot: Array  # end of the last step that passed a switch, -infinity if none
    tries: Array  # to end at the next switch, up to here
    crossings: Array  # steps taken again for a switch, since the time `since`
    since: Array
    last: Array  # see `_last`


class _OtherEnd(NamedTuple):
    """Why a step should have another end, `again`, if it is accurate.

    - `passed`: it passed a switch, and should end there.
    - `short`: it aims at one, and ends just before.
    - `unsure`: it may have passed one unseen.
    - `missed`: it aims at one and ends well before. It is kept, and the next one ends
      where the switch was passed.
    """

    passed: Array
    short: Array
    unsure: Array
    missed: Array
    again: Array


class Landing(eqx.Module):
    """Ends steps at known times and where elements switch."""

    jumps: Array | None
    clocks: tuple[Clock, ...]
    apart: Array  # see `clearance`
    switches: bool = eqx.field(static=True)

    @property
    def timed(self) -> bool:
        return self.jumps is not None or bool(self.clocks)

    def _known(self, t: Array) -> Array | None:
        """Returns known times, the next one after `t` among them; None without any."""
        times = [clock.near(t) for clock in self.clocks]
        times += [] if self.jumps is None else [self.jumps]
        return jnp.concatenate(times) if times else None

    def end_of_run(self, ts: Array) -> Array:
        """Returns the end of the last step: `ts[-1]`, or later if rates jump there."""
        end = ts[-1]
        last = _last(end)
        if (jumps := self._known(last)) is None:
            return end
        # Steps land on what comes before `last`, and go on after it.
        belongs = has_come(jumps, end) | (jumps < last + self.apart)
        there = (jumps >= last - self.apart) & belongs
        later = jnp.any(constant(there))
        return end + jnp.where(later, _LONGER * self.apart, 0)

    def _cut(self, t0: Array, t1: Array, last: Array) -> tuple[Array, Array, Array]:
        """Returns a step's end, the gap after it, and whether it is at a known time."""
        if (known := self._known(t0)) is None:
            return t1, jnp.zeros_like(t1), jnp.array(False)
        jumps = constant(known)
        ends = jnp.maximum(jumps - self.apart, t0)
        ends = jnp.where((jumps > t0) & (ends < last), ends, jnp.inf)
        index = jnp.argmin(ends)
        place, jump = ends[index], jumps[index]
        reached = t1 + _JUST_BEFORE * (t1 - t0) >= place
        # Written this way, the end has the derivatives of the known time.
        end = known[index] - (jump - place)
        gap = jnp.where(reached, jump + self.apart - place, 0)
        return jnp.where(reached, end, t1), gap, reached

    def start(self, t0: Array, t1: Array, end: Array) -> tuple[Array, LandingState]:
        """Returns the end of the first step, which the controller ends at `end`."""
        length, last = end - constant(t0), _last(t1)
        end, gap, cut = self._cut(constant(t0), t0 + length, last)
        if self.switches:  # a step of no length finds the sides
            end, gap, cut = t0, jnp.zeros_like(t0), jnp.array(True)
        target = jnp.where(cut, constant(end), jnp.inf)
        overshot, none = jnp.full_like(target, -jnp.inf), jnp.zeros((), int)
        since = constant(jnp.asarray(t0))
        return end, LandingState(target, gap, length, overshot, none, none, since, last)

    def _other_end(
        self, begin: Array, end: Array, found: Found | None, state: LandingState
    ) -> _OtherEnd:
        if found is None:
            no = jnp.zeros((), bool)
            return _OtherEnd(no, no, no, no, end)
        aimed = end == state.target
        allowance = jnp.where(aimed, found.near, 0)
        within = found.until < jnp.minimum(end - allowance, state.last)
        # A switch that a jump causes at once comes before the next jump, however near.
        at_once = (found.until == begin) & (begin < end)
        # A tiny step that aims at a switch has arrived.
        tiny = (begin < end) & (end - begin <= _APART * self.apart)
        arrived = aimed & (state.gap == 0) & tiny
        passed = (within | at_once) & ~arrived
        unsure = ~passed & (found.unseen < end)
        before = aimed & ~(passed | unsure | found.switched) & (end < state.overshot)
        # A tiny second step would tell little of slopes.
        short = before & (end < found.soon) & (found.soon < state.overshot)
        hopeless = state.tries > _MOST_TRIES
        to_switch = jnp.where(hopeless, begin + (end - begin) / 2, found.until)
        again = jnp.where(passed, to_switch, jnp.where(short, found.soon, found.unseen))
        return _OtherEnd(passed, short, unsure, before & ~short, again)

    def after(
        self, t0: Array, t1: Array, found: Found | None, planned: NextStep,
        state: LandingState,
    ) -> tuple[NextStep, Array, LandingState]:  # fmt: skip
        """Returns the next step, and whether the controller resumes its old state.

        A step is one of these (`planned`: by the controller):

        | step | next step |
        |---|---|
        | rejected by the controller | as planned |
        | retried (see `_OtherEnd`) | the same again, but to another end |
        | ends well before its switch | up to where the switch was passed |
        | ends at a switch or known time | as long as planned before |
        | free | as planned, or up to the next known time |
        """
        begin, end = constant((t0, t1))
        other = self._other_end(begin, end, found, state)
        crossed = planned.keep & (other.passed | other.short)
        retried = crossed | (planned.keep & other.unsure)
        keep = planned.keep & ~retried
        missed, aimed = keep & other.missed, end == state.target
        landed = keep & aimed
        resumes = retried | landed

        # Where does the next step begin? It keeps the derivatives of this one's ends,
        # which `begin`, `end` and `planned` lack.
        next_t0 = jnp.where(keep, t1 + (planned.t0 - end), t0)
        next_t0 = next_t0 + jnp.where(landed, state.gap, 0)

        # Where is it to end? The error of a step that was cut short says little.
        cut_short = resumes & aimed
        length = jnp.where(cut_short, state.resumed, planned.t1 - planned.t0)
        next_t1 = jnp.where(missed, state.overshot, next_t0 + length)
        next_t1, gap, cut = self._cut(constant(next_t0), next_t1, state.last)
        # What a jump at a known time makes switch, switches at exactly that time.
        again = jnp.where(other.again == begin, t0, other.again)
        next_t1 = jnp.where(retried, again, next_t1)
        aims = jnp.where(retried, crossed, cut | missed)

        # Does the solve go on?
        # Time that passes meanwhile tells fast switching from chatter.
        power: Any = _PACE
        if found is not None and found.resets is not None:
            power = jnp.where(found.resets, _RESET_PACE, _PACE)
        pace = self.apart * jnp.finfo(begin.dtype).eps ** power
        paced = crossed & (begin - state.since > pace)
        crossings = jnp.where(paced, 0, state.crossings + crossed)
        results = diffrax.RESULTS
        # The last step may be shorter than the least length; no step follows it.
        done = keep & (end >= state.last)
        result = results.where(resumes | done, results.successful, planned.result)
        chatter = (crossings > _MOST_CROSSINGS) & (result == results.successful)
        result = results.where(chatter, results.max_steps_rejected, result)

        state = state._replace(
            target=jnp.where(aims, constant(next_t1), jnp.inf),
            gap=jnp.where(retried, 0, gap),
            resumed=length,
            overshot=jnp.where(
                planned.keep & other.passed,
                end,
                jnp.where(keep & ~missed, -jnp.inf, state.overshot),
            ),
            tries=jnp.where(keep & ~missed, 0, state.tries + crossed),
            crossings=crossings,
            since=jnp.where(paced, begin, state.since),
        )
        jumped = landed | planned.jumped
        return NextStep(keep, next_t0, next_t1, jumped, result), resumes, state
