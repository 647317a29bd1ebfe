"""Switches of elements between the branches of their formulas, and the jumps there.

Within a step the branches are fixed, so its equations are smooth. A step over a switch
is replaced by one that ends there.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from ..base.trees import constant
from ..linkage.fields import Truth
from .dopri8 import SHORTEST, DenseOutput
from .exact_zeros import at_zero, later, met, places_of, sides_after
from .landing import Found, clearance
from .switch_derivatives import Event, gained, gained_at_kink, lateness, moved
from .term import Arguments, Integrated, Term
from .zeros import CHECKED, CHECKS, SAMPLED, SHARES, passage

# A function whose zero is this close to the end of a step switches there: a share of
# the step, as a power of the unit of rounding (1e-9 in float64).
_NEAR = 0.575
# A function began on its zero if its values before were below this share of its size,
# also a power of the unit of rounding.
_ON_ZERO = 0.625
# In steps of at most this many such distances, hidden zeros are not looked for.
_BRIEF = 10


class SwitchState(NamedTuple):
    """The state of the switching functions where a step ended.

    - `sides` (switch,): those in this step: 1 above and -1 below zero, 0 before the
      start.
    - `after`: those after a switch here.
    - `until`, `near`: see `Found`.
    - `sizes` (switch,): the largest values so far.
    - `early`: whether a function that switches here has not quite reached its zero.
    - `passed`: number of switches so far.
    - `one_sided`: number of places so far with one-sided derivatives, see
      `EventHandler`; None if nothing jumps at switches.
    - `grazing`, `grazing_here`: how nearly crossings grazed so far, and here; 0 if
      none.
    - `late`: 0, with the derivatives of the time of the event where this step began;
      None without modes.
    - `resets` (reset,): which are met here; `ended`: which condition ended the run, -1
      if none did. Each is None without any.
    """

    sides: Array
    after: Array
    until: Array
    near: Array
    sizes: Array
    length: Array
    early: Array
    passed: Array
    one_sided: Array | None
    grazing: Array
    grazing_here: Array
    modes: PyTree
    late: Any  # Array | None
    resets: Any  # Array | None
    ended: Array | None

    @property
    def facts(self) -> dict[str, Array]:
        sided = {} if self.one_sided is None else {"one_sided": self.one_sided}
        grazing = self.grazing
        if self.ended is not None:
            grazing = jnp.maximum(
                grazing, jnp.where(self.ended < 0, 0, self.grazing_here)
            )
        slowest = {"slowest_crossing": 1 / grazing}
        return {"num_switches": self.passed} | sided | slowest


class Regime(NamedTuple):
    """The branches and modes in a step, and what has changed at its beginning.

    - `changed` (switch,): which functions switched there; `on_zero`: which begin near
      their zeros, as after a switch.
    - `sizes`: their largest values before, 0 of new functions.
    - `grazing`, `late`: see `SwitchState`.
    """

    sides: Array
    modes: PyTree
    changed: Array
    on_zero: Array
    sizes: Array
    grazing: Array
    late: Any  # Array | None


class EventHandler(eqx.Module):
    """Finds where something happens in a step, and does it where the next one begins.

    Where efforts jump, derivatives may hold on one side only if a motion starts on a
    switch or meets two at once.

    - `jumping`: whether efforts jump where each function switches; None of conditions.
      The last `guards` functions guard modes.
    - `resets`, `ends`: (place, direction) of the conditions that reset the state, and
      that end the run; 0 stands for both directions.
    - `derivatives`: whether states get those of the times of events.
    """

    term: Any
    apart: Array  # see `clearance`
    jumping: tuple[bool | None, ...] = eqx.field(static=True)
    guards: int = eqx.field(static=True)
    resets: tuple[tuple[int, int], ...] = eqx.field(static=True)
    ends: tuple[tuple[int, int], ...] = eqx.field(static=True)
    derivatives: bool = eqx.field(static=True)

    def start(self, t0: Array, args: Arguments) -> SwitchState:
        modes = self.term.unknown_modes(args)[0] if self.guards else None
        count, none = len(self.jumping), jnp.zeros_like(t0)
        unknown, no = jnp.zeros(count, t0.dtype), jnp.array(False)
        known = unknown.at[count - self.guards :].set(1)
        return SwitchState(
            sides=known,
            after=known,
            until=t0,
            near=none,
            sizes=unknown,
            length=none,
            early=no,
            passed=jnp.zeros((), int),
            one_sided=jnp.zeros((), int) if any(self.jumping) else None,
            grazing=none,
            grazing_here=none,
            modes=modes,
            late=none if self.guards else None,
            resets=jnp.zeros(len(self.resets), bool) if self.resets else None,
            ended=jnp.array(-1) if self.ends else None,
        )

    # What happens where a step ended?

    def crossed(
        self, t: Array, y: Integrated, args: Arguments, last: SwitchState, jumped: Truth
    ) -> tuple[Integrated, Regime]:
        """Returns the state where a step begins, and what is in force in it.

        `t`, `y`: before what happens there; `jumped`: whether something may.
        """
        if_jumped = lambda after, before: jnp.where(jumped, after, before)
        sides, modes, sizes = if_jumped(last.after, last.sides), last.modes, last.sizes
        late = None
        on_zero = sides != last.sides
        changed = on_zero & (last.sides != 0)
        if not self.guards:
            y = self._shifted(t, y, args, last, jumped)
        else:
            sides = sides.at[-self.guards :].set(1)
            at_start = jnp.any(modes.mode < 0)
            y, modes, sides, late = jax.lax.cond(
                jumped | at_start,
                lambda: self._after_event(t, y, args, last, sides, changed, jumped),
                lambda: (y, modes, sides, jnp.zeros_like(t)),
            )
            # Other modes have other guards.
            old = last.modes
            same = (modes.mode == old.mode) & (modes.direction == old.direction)
            guards = jnp.arange(sides.size) >= sides.size - self.guards
            new = guards & (changed[-self.guards :].any() | ~same.all())
            on_zero, sizes = on_zero | new, jnp.where(new, 0, sizes)
        grazing = jnp.maximum(last.grazing, if_jumped(last.grazing_here, 0))
        return y, Regime(sides, modes, changed, on_zero, sizes, grazing, late)

    def _after_event(
        self, t: Array, y: Integrated, args: Arguments, last: SwitchState, sides: Array,
        changed: Array, jumped: Truth,
    ) -> tuple[Integrated, PyTree, Array, Array]:  # fmt: skip
        """Returns state, modes and sides after an event, and `SwitchState.late`.

        The state moves on to the time of the event in the modes before, and back in
        those after. Except for resets, this changes nothing but derivatives.
        """
        before = args._replace(sides=last.sides, modes=last.modes)
        fired = changed[-self.guards :].reshape(-1, last.modes.mode.size)
        time = jnp.where(last.early, t, last.until)
        late, there = jnp.zeros_like(t), y
        resets: Any = None
        # What an event causes at once has the time of that event.
        comes = last.length > 0
        if self.derivatives:
            arrived = changed & jumped & comes
            late = jax.lax.cond(
                jnp.any(arrived),
                lambda: lateness(time, y, before, jnp.argmax(arrived), self.term),
                lambda: jnp.where(comes, 0, last.late),
            )
            there = moved(late, time, y, before, self.term)
        end = at = t + late
        if self.resets:
            resets = last.resets & jumped
            which = places_of(self.resets)[jnp.argmax(resets)]
            at, there = at_zero(
                self.term, end, there, before, which, resets.any() & comes
            )
        arrived_as = there, before
        own = before._replace(sides=sides)
        event = Event(last.until + late, at, fired, resets)
        there, modes = self.term.resolve(event, there, own)
        after = args._replace(sides=sides, modes=modes)
        if self.resets:
            places = places_of(self.resets)
            left = sides_after(
                self.term, places, at, arrived_as, (there, after), last.sizes
            )
            left = jnp.where(resets, left, sides[places])
            sides = sides.at[places].set(left.astype(t.dtype))
            after = args._replace(sides=sides, modes=modes)
            there = later(self.term, end - at, at, there, after)
        if self.derivatives:
            there = moved(-late, end, there, after, self.term)
        return there, modes, sides, late

    def _shifted(
        self, t: Array, y: Integrated, args: Arguments, last: SwitchState, jumped: Truth
    ) -> Integrated:
        """Returns the state with the derivatives that a switch brings."""
        if not self.derivatives:
            return y
        before, after = last.sides, last.after
        in_turn = [before, after]
        # Kinks change second derivatives alone.
        if any(self.jumping) and before.size > 1:
            first = (before != after) & (jnp.cumsum(before != after) == 1)
            in_turn.insert(1, jnp.where(first, after, before))
        # A known time may be here too, just before the zeros or just after them.
        t = jnp.where(last.early, t, last.until)
        # In a step of no length no function comes to its zero gradually: it jumped, at
        # a known time.
        arrived = jumped & (last.length > 0)
        gain_of = gained if any(self.jumping) else gained_at_kink
        for before, after in zip(in_turn, in_turn[1:]):
            own, then = (args._replace(sides=sides) for sides in (before, after))
            switched = (before != after) & arrived
            gain = gain_of(t, y, own, then, switched, term=self.term)
            y = jax.tree.map(jnp.add, y, gain)
        return y

    # What happens in a step?

    def held_still(self, regime: Regime, y1: Integrated, y0: Integrated) -> Integrated:
        """Returns the end of a step, with held joints as at its beginning.

        Earlier rounding errors in the compensated sum would still move them.
        """
        if not self.guards:
            return y1
        held = regime.modes.held

        def still(new: PyTree, old: PyTree) -> PyTree:
            if eqx.is_array(new):
                return jnp.where(held, old, new)
            return tuple(jnp.where(*row) for row in zip(held, old, new))

        return (*map(still, y1[:2], y0[:2]), *y1[2:])

    def located(
        self, t0: Array, t1: Array, path: diffrax.AbstractLocalInterpolation,
        own: Arguments, regime: Regime, last: SwitchState,
    ) -> tuple[Found, SwitchState]:  # fmt: skip
        """Returns what a step found, and the state where it ended."""
        sides, h = regime.sides, t1 - t0
        # Lengths of steps to a switch say nothing about the pace of the motion.
        share = jnp.finfo(t1.dtype).eps ** _NEAR
        near = jnp.maximum(jnp.maximum(share * h, last.near / 2), self.apart)
        values, checks = _values(*constant((self.term, t0, t1, path, own)))
        brief = h <= jnp.maximum(SHORTEST[t1.dtype], _BRIEF * near)
        at = values, checks, sides, regime.on_zero, regime.sizes, near / h, brief
        passed = passage(*constant(at))
        # A function that began on its zero has left it, after one or more steps.
        left = jnp.finfo(passed.sizes.dtype).eps ** _ON_ZERO * passed.sizes
        on_zero = last.sizes <= left
        # Before the first step, whose length is 0, sides are unknown.
        after = jnp.where(passed.switched, -sides, sides)
        after = jnp.where(sides == 0, jnp.where(values[-1] > 0, 1.0, -1.0), after)
        until = jnp.where(passed.crossed, t0 + passed.until * h, t1)
        passed_zero = passed.switched & ~on_zero
        resets = None
        if self.resets:
            resets = met(self.resets, passed_zero, after)
        found = Found(
            until=until,
            unseen=jnp.where(passed.unseen < 1, t0 + passed.unseen * h, t1),
            soon=t1 + passed.soon * h,
            near=near,
            switched=jnp.any(after != sides),
            resets=None if resets is None else resets.any(),
        )
        return constant(found), SwitchState(
            sides=sides,
            after=after.astype(t0.dtype),
            until=until,
            near=near,
            sizes=passed.sizes,
            length=h,
            early=jnp.any(passed.switched & (sides * values[-1] > 0)),
            passed=last.passed + jnp.sum(regime.changed & ~on_zero),
            one_sided=self._one_sided(last, on_zero, regime, passed.sizes),
            grazing=jnp.maximum(passed.missed, regime.grazing),
            grazing_here=passed.grazing,
            modes=regime.modes,
            late=regime.late,
            resets=resets,
            ended=self._ended(passed_zero, after),
        )

    def _ended(self, passed: Array, after: Array) -> Array | None:
        """Returns which condition ends the run in a step, see `SwitchState.ended`.

        `passed`: which functions passed a zero on which they had not begun.
        """
        if not self.ends:
            return None
        ends = met(self.ends, passed, after)
        return jnp.where(ends.any(), jnp.argmax(ends), -1)

    def at_end(
        self, t: Array, y: Integrated, args: Arguments, last: SwitchState
    ) -> tuple[Array, Integrated]:
        """Returns time and state at the zero of the condition that ended a run.

        Without such a condition, they are those given, of the last step's end.
        """
        args = args._replace(sides=last.sides, modes=last.modes)
        assert last.ended is not None
        ended, comes = last.ended >= 0, last.length > 0
        which = places_of(self.ends)[last.ended]
        end, there = at_zero(self.term, t, y, args, which, ended & comes)
        if last.late is None:
            return end, there
        # A jump carried it over its zero: at the time of that event.
        late = jnp.where(ended & ~comes, last.late, 0)
        return end + late, moved(late, end, there, args, self.term)

    def _one_sided(
        self, last: SwitchState, on_zero: Array, regime: Regime, sizes: Array
    ) -> Array | None:
        if last.one_sided is None:
            return None
        jumping = np.array(self.jumping, bool)
        at_once = jumping & on_zero & (sizes > 0) & (regime.sides != 0)
        at_once = jnp.any(at_once[: sizes.size - self.guards])
        several = jnp.sum(regime.changed & jumping) > 1
        together = several & (last.grazing_here > 0)
        return jnp.maximum(last.one_sided, at_once) + together


def events_of(
    term: Term, ts: Array, y0: Integrated, args: Arguments,
    conditions: list[tuple[bool, int]], derivatives: bool,
) -> EventHandler | None:  # fmt: skip
    """Returns the events of a run over the times `ts`, None if nothing switches.

    `conditions`: whether each resets the state (else it ends the run), and its
    direction.
    """
    guards = 0
    if term.unknown_modes is not None:
        modes, guards = term.unknown_modes(args)
        args = args._replace(modes=modes)
    functions, jumping = eqx.filter_eval_shape(term.switches, ts[0], y0, args)
    if not functions.size:
        return None
    places = [place for place, jumps in enumerate(jumping) if jumps is None]
    resets, ends = (
        tuple((k, way) for k, (one, way) in zip(places, conditions) if one == resets)
        for resets in (True, False)
    )
    return EventHandler(term, clearance(ts), jumping, guards, resets, ends, derivatives)


@eqx.filter_jit  # traced once, not at each use in a solve
def _values(
    term: Term, t0: Array, t1: Array, path: diffrax.AbstractLocalInterpolation,
    args: Arguments,
) -> tuple[Array, Array]:  # fmt: skip
    """Returns the switching functions at the samples of a step, and at its checks."""
    shares = jnp.asarray([*SHARES, *CHECKS], t0.dtype)
    times = t0 + shares * (t1 - t0)
    if isinstance(path, DenseOutput):
        places = np.array((*SAMPLED, *CHECKED))
        scheduled = jax.tree.map(lambda rows: rows[places], path.scheduled)
        one = lambda row: term.switching(row[1], path.at(row[0]), args, row[2])[0]
        rows = shares, times, scheduled
        values = jax.vmap(one)(rows)
    else:
        values = jax.vmap(lambda t: term.switches(t, path.evaluate(t), args)[0])(times)
    # An infinite limit is never reached.
    values = jnp.where(jnp.isinf(values), jnp.sign(values), values)
    return values[: len(SHARES)], values[len(SHARES) :]
