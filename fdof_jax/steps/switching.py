"""Steps that end where elements switch between the branches of their formulas.

Within a step the branches are those in force at its start, so the step's equations are
smooth. A step over the zero of a switching function is replaced by one that ends there.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from ..linkage.fields import Truth
from .dopri8 import (
    SHORTEST,
    Arguments,
    DenseOutput,
    Integrated,
    Term,
    constant,
    with_change,
)
from .landing import Landing, clearance
from .switch_derivatives import Event, gained, gained_at_kink, lateness, moved
from .zeros_in_steps import CHECKED, CHECKS, SAMPLED, SHARES, passage

# A function whose zero is this close to the end of a step switches there: a share of
# the step, as a power of the unit of rounding (1e-9 in float64).
_NEAR = 0.575
# A function began on its zero if its values before were below this share of its size,
# also a power of the unit of rounding.
_ON_ZERO = 0.625
# In steps of at most this many such distances, hidden zeros are not looked for.
_BRIEF = 10


class Switching(NamedTuple):
    """The state of the switches: the last entry of the integrated state.

    - `sides` (switch,): those in force in the step that ended here: 1 above and -1
      below zero, and 0 before the start.
    - `after`: those after a switch here.
    - `until`: when the step should have ended; its end if nothing switched before [s].
    - `unseen`: a time before which a switching function may have passed 0 unseen; the
      step's end if none may [s].
    - `soon`: the time of a switch that follows soon after the end; else the end [s].
    - `near`: how far from its zero a switching function may switch [s].
    - `sizes` (switch,): the largest values of the switching functions up to here.
    - `length`: that of the step that ended here [s].
    - `ahead`: 1 if a function that switches here has not quite reached its zero, or 0.
    - `passed`: number of switches up to here.
    - `one_sided`: number of places up to here where derivatives may hold on one side
      only (see `Located`); None if nothing jumps at switches.
    - `grazing`, `grazing_here`: how nearly the crossings so far grazed, and the one
      here; 0 if none (see `Passage`).
    - `modes`: those of the joints (see `ScheduledTerm`), None if elements hold none.
    """

    sides: Array
    after: Array
    until: Array
    unseen: Array
    soon: Array
    near: Array
    sizes: Array
    length: Array
    ahead: Array
    passed: Array
    one_sided: Array | None
    grazing: Array
    grazing_here: Array
    modes: PyTree = None


def in_force(args: Arguments, y: Integrated) -> Arguments:
    """Returns the arguments with what is in force at a state, if it has switches."""
    if not isinstance(switching := y[-1], Switching):
        return args
    return args._replace(sides=switching.sides, modes=switching.modes)


def motion_of(y: Integrated) -> Integrated:
    """Returns a state without that of the switches."""
    return y[:-1] if y is not None and isinstance(y[-1], Switching) else y


def located(
    solver: diffrax.AbstractSolver,
    term: Term,
    ts: Array,
    y0: Integrated,
    args: Arguments,
    jumps: Array | None,
    derivatives: bool,
) -> tuple[diffrax.AbstractSolver, Landing | None, Integrated]:
    """Returns a solver that finds switches, and the `Landing` that ends steps at them.

    Also returns the start for this solver. Without switches solver and start stay as
    they are. `ts`: the times of the run; `jumps`: known times.
    """
    t0, apart = ts[0], clearance(ts)
    jumps = None if jumps is None else jnp.asarray(jumps, t0.dtype)
    modes, guards = None, 0
    if term.unknown_modes is not None:
        modes, guards = term.unknown_modes(args)
        args = args._replace(modes=modes)
    functions, jumping = eqx.filter_eval_shape(term.switches, t0, y0, args)
    switches = functions.size > 0
    if jumps is None and not switches:
        return solver, None, y0
    if switches:
        unknown, none = jnp.zeros(functions.shape, t0.dtype), jnp.zeros_like(t0)
        known = unknown.at[functions.size - guards :].set(1)
        at_start = Switching(
            sides=known,
            after=known,
            until=t0,
            unseen=t0,
            soon=t0,
            near=none,
            sizes=unknown,
            length=none,
            ahead=none,
            passed=none,
            one_sided=none if any(jumping) else None,
            grazing=none,
            grazing_here=none,
            modes=modes,
        )
        implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
        kind: Any = LocatedImplicit if implicit else Located
        solver = kind(solver, jumping, apart, guards, derivatives)
        y0 = *y0, at_start
    return solver, Landing(jumps, apart, switches), y0


def switching_facts(*states: Switching) -> dict[str, Array]:
    """Returns the statistics of the switches at the end of a solve."""
    facts = {}
    for switching in states:
        facts["num_switches"] = switching.passed[0].astype(int)
        if switching.one_sided is not None:
            facts["one_sided"] = switching.one_sided[0].astype(int)
        facts["slowest_crossing"] = 1 / switching.grazing[0]
    return facts


class Located(diffrax.AbstractAdaptiveSolver):
    """A solver whose steps keep the branches of their start and report a change.

    Where efforts jump at a switch, a motion that starts on it, or meets it together
    with another, may have different derivatives on its two sides.
    """

    solver: Any
    jumping: tuple[bool, ...] = eqx.field(static=True)  # whether efforts do, (switch,)
    apart: Array  # see `clearance`
    guards: int = eqx.field(static=True)  # switching functions that guard modes
    derivatives: bool = eqx.field(static=True)

    @property
    def term_structure(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore
        kind = self.solver.interpolation_cls
        return functools.partial(_WithModes, kind) if self.guards else kind

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, motion_of(y0), in_force(args, y0))

    def step(self, terms, t0: Any, t1: Any, y0, args, solver_state, made_jump):
        term, h, switching, y0 = terms.term, t1 - t0, y0[-1], y0[:-1]
        modes, earlier = switching.modes, switching.sizes
        if_jumped = lambda after, before: jnp.where(made_jump, after, before)
        sides = if_jumped(switching.after, switching.sides)
        begun = sides != switching.sides
        changed = begun & (switching.sides != 0)
        if self.guards:
            sides = sides.at[-self.guards :].set(1)
            unchanged = y0, modes
            here = term, t0, y0, args, switching, sides, changed, made_jump
            y0, modes = jax.lax.cond(
                made_jump | jnp.any(modes.mode < 0),  # or at the very start
                lambda: self.after_event(*here),
                lambda: unchanged,
            )
            # Other modes have other guards.
            old = switching.modes
            same = (modes.mode == old.mode) & (modes.direction == old.direction)
            guards = jnp.arange(sides.size) >= sides.size - self.guards
            other = guards & (changed[-self.guards :].any() | ~same.all())
            begun, earlier = begun | other, jnp.where(other, 0, earlier)
            args = args._replace(sides=sides, modes=modes)
        else:
            args = args._replace(sides=sides)
            y0 = self.shifted(term, t0, y0, args, switching, made_jump)
        y1, error, dense, solver_state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, made_jump
        )
        path = self.solver.interpolation_cls(t0=t0, t1=t1, **dense)
        if self.guards:
            # Joints that are held keep their values: rounding errors of earlier steps,
            # which the compensated sum carries, would still move them.
            y1 = self.kept(modes.held, y1, y0)
            dense = dict(path=dense, modes=modes)

        # Lengths of steps to a switch say nothing about the pace of the motion.
        share = jnp.finfo(t1.dtype).eps ** _NEAR
        near = jnp.maximum(share * h, switching.near / 2)
        near = jnp.maximum(near, self.apart)
        values, checks = _values(*constant((term, t0, t1, path, args)))
        brief = h <= jnp.maximum(SHORTEST[t1.dtype], _BRIEF * near)
        passed = passage(values, checks, sides, begun, earlier, near / h, brief)
        # A function that began on its zero has left it, after one or more steps.
        left = jnp.finfo(passed.sizes.dtype).eps ** _ON_ZERO * passed.sizes
        on_zero = switching.sizes <= left
        # Before the first step, whose length is 0, sides are unknown.
        after = jnp.where(passed.switched, -sides, sides)
        after = jnp.where(sides == 0, jnp.where(values[-1] > 0, 1.0, -1.0), after)
        grazed = jnp.maximum(switching.grazing, if_jumped(switching.grazing_here, 0))
        new = Switching(
            sides=sides,
            after=after.astype(t0.dtype),
            until=jnp.where(passed.crossed, t0 + passed.until * h, t1),
            unseen=jnp.where(passed.unseen < 1, t0 + passed.unseen * h, t1),
            soon=t1 + passed.soon * h,
            near=near,
            sizes=passed.sizes,
            length=h,
            ahead=jnp.any(passed.switched & (sides * values[-1] > 0)).astype(t0.dtype),
            passed=switching.passed + jnp.sum(changed & ~on_zero),
            one_sided=self.one_sided(switching, on_zero, sides, passed.sizes, changed),
            grazing=jnp.maximum(passed.missed, grazed),
            grazing_here=passed.grazing,
            modes=modes,
        )
        if error is not None:  # None: a method without an estimate
            none = jax.tree.map(jnp.zeros_like, new)
            error = with_change(error, lambda error: (*error, none))
        return (*y1, new), error, dense, solver_state, result

    def one_sided(
        self,
        switching: Switching,
        on_zero: Array,
        sides: Array,
        sizes: Array,
        changed: Array,
    ) -> Array | None:
        """Returns `Switching.one_sided` at the end of a step."""
        if switching.one_sided is None:
            return None
        jumping = np.array(self.jumping)
        at_once = jumping & on_zero & (sizes > 0) & (sides != 0)
        at_once = jnp.any(at_once[: sides.size - self.guards])
        together = (jnp.sum(changed & jumping) > 1) & (switching.grazing_here > 0)
        return jnp.maximum(switching.one_sided, at_once) + together

    def after_event(
        self, term: Term, t: Array, y: Integrated, args: Arguments,
        switching: Switching, sides: Array, changed: Array, made_jump: Truth,
    ) -> tuple[Integrated, PyTree]:  # fmt: skip
        """Returns state and modes after an event at the start of a step.

        The state moves on to the time of the event in the modes before, and back in
        those after: this changes nothing but derivatives.
        """
        before = args._replace(sides=switching.sides, modes=switching.modes)
        fired = changed[-self.guards :].reshape(-1, switching.modes.mode.size)
        time = jnp.where(switching.ahead > 0, t, switching.until)
        late, there = jnp.zeros_like(t), y
        if self.derivatives:
            arrived = changed & made_jump & (switching.length > 0)
            late = jax.lax.cond(
                jnp.any(arrived),
                lambda: lateness(time, y, before, jnp.argmax(arrived), term),
                lambda: jnp.zeros_like(t),
            )
            there = moved(late, time, y, before, term)
        happens = Event(switching.until, t, fired, late)
        there, modes = term.resolve(happens, there, before._replace(sides=sides))
        if self.derivatives:
            after = args._replace(sides=sides, modes=modes)
            there = moved(-late, t + late, there, after, term)
        return there, modes

    def kept(self, held: Array, y1: Integrated, y0: Integrated) -> Integrated:
        """Returns the end of a step, positions and rates of held joints as before."""

        def still(new: PyTree, old: PyTree) -> PyTree:
            if eqx.is_array(new):
                return jnp.where(held, old, new)
            return tuple(jnp.where(*row) for row in zip(held, old, new))

        return (*map(still, y1[:2], y0[:2]), *y1[2:])

    def shifted(
        self, term: Term, t: Array, y: Integrated, args: Arguments,
        switching: Switching, made_jump: Truth,
    ) -> Integrated:  # fmt: skip
        """Returns the state at the start of a step, changed by a switch there."""
        if not self.derivatives:
            return y
        before, after = switching.sides, switching.after
        in_turn = [before, after]
        # Kinks change second derivatives alone.
        if any(self.jumping) and before.size > 1:
            first = (before != after) & (jnp.cumsum(before != after) == 1)
            in_turn.insert(1, jnp.where(first, after, before))
        # A known time may be here too, just before the zeros or just after them.
        t = jnp.where(switching.ahead > 0, t, switching.until)
        # In a step of no length no function comes to its zero gradually: it jumped, at
        # a known time.
        arrived = made_jump & (switching.length > 0)
        gain_of = gained if any(self.jumping) else gained_at_kink
        for before, after in zip(in_turn, in_turn[1:]):
            own, then = (args._replace(sides=sides) for sides in (before, after))
            gain = gain_of(t, y, own, then, (before != after) & arrived, term=term)
            y = jax.tree.map(jnp.add, y, gain)
        return y


class LocatedImplicit(Located, diffrax.AbstractImplicitSolver):
    """An implicit solver with switches, whose tolerances diffrax sets."""

    @property
    def root_finder(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.root_finder

    @property
    def root_find_max_steps(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.root_find_max_steps


class _WithModes(diffrax.AbstractLocalInterpolation):
    """The path of a step, with the modes in it as the last entry of its states."""

    kind: Callable[..., diffrax.AbstractLocalInterpolation] = eqx.field(static=True)
    t0: Array  # pyright: ignore[reportIncompatibleVariableOverride]
    t1: Array  # pyright: ignore[reportIncompatibleVariableOverride]
    path: dict[str, PyTree]
    modes: PyTree

    def evaluate(self, t0, t1=None, left=True):
        path = self.kind(t0=self.t0, t1=self.t1, **self.path)
        return *path.evaluate(t0, t1, left), self.modes


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
