"""Integrates the equations of motion with diffrax: free, prescribed, differentiated.

`integrate` is the one way in: it prepares, controls, solves and reads.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ..base.checks import refusal
from ..base.known_values import known_array
from ..forces.element import Element, OwnStates
from ..forces.joints import EffortHistory
from ..linkage.linkage import Linkage, possible, without_fixed
from ..steps.controllers import Controller, default_controller, with_error_control
from ..steps.derivative_control import OfLinearised, OfTangents
from ..steps.dopri8 import Integrated, ScheduledDopri8, ScheduledTerm, constant
from ..steps.landing import end_of_run
from ..steps.looped_dopri8 import LoopedDopri8
from ..steps.step_control import StepControl, largest_loss
from ..steps.switching import Switching, located, switching_facts
from ..steps.unchecked import diffeqsolve
from .events import in_order
from .field import Args, args_of, in_arrays, initial_own, own_states, whole
from .formulation import clocks_apart, formulation, known_times
from .holding import Modes, changes, taken_at, within_stops
from .prescribed import agrees
from .solution import Solution

Settings = dict[str, Any]  # keywords of `diffeqsolve`, as `solve_options` checks them


class Inputs(NamedTuple):
    """The arguments that determine a motion, as `simulate` gets them.

    - `own0`: initial states of the elements, or None for their defaults.
    - `known_ef`: existence factors that the program may contain, or None.
    """

    linkage: Linkage
    state0: Any  # a State of arrays
    ts: Array
    own0: OwnStates | None
    forces: tuple[Element, ...]
    known_ef: tuple[float, ...] | None = None


class _Problem(NamedTuple):
    """The equations to integrate, their start and output times.

    - `valid`: whether the inputs were; others have stand-ins here.
    - `ts`: output times of the solve; `first`: positions and velocities at the first.
    - `term`, `start`, `args`: the equations, the integrated state there, and constants.
    - `joints(t, y)`: reads positions, velocities and the elements' own states.
    """

    valid: Array
    ts: Array
    first: tuple[Array, Array]
    term: ScheduledTerm
    start: Integrated
    args: Args
    joints: Callable[[Array, Integrated], tuple[Array, Array, OwnStates]]


class _Control(NamedTuple):
    """The solver, the step control, and the start, with the state of any switches."""

    start: Integrated
    solver: diffrax.AbstractSolver
    steps: Controller
    jumps: Array | None


def integrate(
    inputs: Inputs,
    keywords: Settings,
    derivatives: bool = False,
    plain: bool = False,
    tangents: OfTangents | None = None,
) -> Solution:
    """Integrates one motion, by default with `LoopedDopri8`.

    `derivatives`: whether steps are kept short enough for accurate derivatives.
    `plain`: whether this is one motion outside of transformations. Its last time may be
    repeated.
    `tangents`: judges tangents over which the caller maps, along the axis `TANGENTS`.
    """
    problem = _prepare(inputs, derivatives, plain)
    # Loops of few motions compile and run faster in arrays.
    if plain and not derivatives or tangents and tangents.tolerance:
        term, start, args = in_arrays(problem.term, problem.start, problem.args)
        problem = problem._replace(term=term, start=start, args=args)
    control = _control(problem, keywords, derivatives, tangents)
    return _read(inputs, problem, _solve(problem, control, keywords))


def _prepare(inputs: Inputs, derivatives: bool, plain: bool) -> _Problem:
    """States the equations and their start."""
    linkage, state0, ts, own0, forces, ef = inputs
    # An arm may be of a time before double precision was chosen.
    linkage = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), linkage)
    if ef is not None:  # the equations of other joints are left out
        linkage = eqx.tree_at(lambda arm: arm.ef, linkage, known_array(ef))
    wrong_times, wrong_start, *others = faults(inputs, times=not plain)
    valid = ~jnp.stack([wrong_times, wrong_start, *others]).any()
    # Stand-ins replace invalid values, because NaN in one lane would spoil derivatives
    # in arrays that lanes share.
    q0, qd0 = (without_fixed(linkage, jnp.where(wrong_start, 0, a)) for a in state0)
    stand_in = 1e-3 * jnp.arange(len(ts), dtype=ts.dtype)
    ts = jnp.where(wrong_times, stand_in, ts)
    args = args_of(linkage, q0, forces)
    if derivatives:
        args = clocks_apart(args, ts)
    own = initial_own(args, own0)
    finite = jnp.isfinite(jnp.array(own)).all()
    own = tuple(jnp.where(finite, x, 0) for x in own)
    term, start_of, joints_of = formulation(forces)
    start = whole(*start_of(args, qd0), own)

    def joints(t, y):
        return *joints_of(args, t, y), own_states(args, y)

    q, qd, _ = joints(ts[0], start)  # after a blow there, like all that follows
    return _Problem(valid & finite, ts, (q, qd), term, start, args, joints)


def _control(
    problem: _Problem, keywords, derivatives: bool, tangents: OfTangents | None
) -> _Control:
    """Chooses the steps: what they judge, and where they end."""
    solver: diffrax.AbstractSolver = keywords["solver"] or LoopedDopri8()
    solver = _differentiable(solver, keywords["adjoint"])
    given = keywords["stepsize_controller"]  # by the user
    steps = given or default_controller()
    term, start, args, ts = problem.term, problem.start, problem.args, problem.ts
    if not isinstance(steps, diffrax.AbstractAdaptiveStepSizeController):
        why = None
        # Fixed steps may step over the kinks of an `EffortHistory`, but not over jumps.
        jumping = (e for e in args.forces if not isinstance(e, EffortHistory))
        if any(e.jump_ts is not None for e in jumping):
            why = "declare times at which they jump (jump_ts)"
        elif changes(args.forces):
            why = "hold joints or take payloads"
        if why is not None:
            expected = f"an adaptive one, as forces {why}"
            raise refusal("stepsize_controller", expected, steps)
        return _Control(start, solver, steps, None)
    jumps = known_times(args)
    implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
    of_run = ts, start, args, jumps
    wrapped, landing, start = located(solver, term, *of_run, derivatives)
    watches = not isinstance(solver, ScheduledDopri8)  # which finds the health itself
    of_derivatives = tangents
    # Who sets tolerances of an implicit solver wants very fast motions left unresolved;
    # a probe would make steps short enough to resolve them.
    if derivatives and not tangents and not (implicit and given is not None):
        has_tableau = isinstance(solver, ScheduledDopri8 | diffrax.AbstractRungeKutta)
        # Of other solvers derivatives are judged as if they were by Heun's method.
        tableau: Any = solver.tableau if has_tableau else diffrax.Heun.tableau
        of_derivatives = OfLinearised(term, tableau)
    settings = term, watches, landing, of_derivatives
    control = lambda steps: StepControl(steps, *settings)  # pyright: ignore[reportCallIssue]
    return _Control(start, wrapped, with_error_control(control, steps), jumps)


def _solve(problem: _Problem, control: _Control, keywords) -> diffrax.Solution:
    """Integrates; also saves the last time that was reached, and the switches there."""
    ts, size = problem.ts, len(problem.start)
    adaptive = isinstance(control.steps, diffrax.AbstractAdaptiveStepSizeController)

    def row(t, y, args):
        """Returns the state, and the modes if joints are held."""
        # Between the ends of steps a state has the modes alone as its last entry.
        last = y[-1].modes if isinstance(y[-1], Switching) else y[-1]
        has_modes = isinstance(last, Modes)
        return (*y[:size], last._replace(events=None)) if has_modes else y[:size]

    outputs = (
        diffrax.SubSaveAt(ts=ts, fn=row),
        diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: (t, *y[size:])),
    )
    keywords = keywords | {
        "solver": control.solver,
        "stepsize_controller": control.steps,
    }
    # diffrax computes a few constants while it is traced.
    with jax.transfer_guard("allow"):
        return diffeqsolve(
            problem.term,
            t0=ts[0],
            t1=end_of_run(ts, control.jumps),
            y0=control.start,
            args=problem.args,
            saveat=diffrax.SaveAt(subs=outputs, controller_state=adaptive),
            throw=False,
            **keywords,
        )


def _read(inputs: Inputs, problem: _Problem, solve: diffrax.Solution) -> Solution:
    """Reads joint states, statistics and the result."""
    linkage, state0, times, *_ = inputs
    valid, ts = problem.valid, problem.ts
    assert solve.ys is not None  # because of saveat
    states, (reached, *switches) = solve.ys
    states, modes = states[: len(problem.start)], states[len(problem.start) :]
    q, qd, own = jax.vmap(problem.joints)(ts, states)

    def shown_at(a):
        """Replaces the infinity that diffrax leaves at times not reached by NaN."""
        return jnp.where(jnp.isinf(a) | ~valid, jnp.nan, a)

    # diffrax saves the start with the first step only, after any blow there.
    saved = jnp.isfinite(qd[0]) & valid if modes else None

    def from_start(rows, start, given):
        """Returns rows whose first one is the start, or what was given if invalid."""
        first = jnp.where(valid, start, given)
        if saved is not None:
            first = jnp.where(saved, rows[0], first)
        return shown_at(rows).at[0].set(first)

    given = (without_fixed(linkage, value) for value in state0)
    q, qd = map(from_start, (q, qd), problem.first, given)
    # Constant steps go on when the state is no longer finite.
    reached = jnp.minimum(reached[0], ts[-1])
    not_finite = (ts <= reached) & ~jnp.isfinite(q + qd).all(axis=1)
    last_finite = ts[jnp.maximum(jnp.argmax(not_finite) - 1, 0)]
    reached = jnp.where(not_finite.any(), last_finite, reached)
    stats = solve.stats | {"time_reached": jnp.where(valid, reached, times[0])}
    if solve.controller_state is not None:
        loss = largest_loss(solve.controller_state)
        stats["accuracy"] = jnp.finfo(q.dtype).eps * loss
    stats |= switching_facts(*switches)
    results: Any = diffrax.RESULTS
    # Constant steps, if too long, end in NaN and still report success.
    finite = (jnp.isfinite(q[-1]) & jnp.isfinite(qd[-1])).all()
    finite = finite | (solve.result != results.successful)
    result = results.where(valid & finite, solve.result, results.nonfinite)
    holding: Any = ()  # modes, energy taken, events
    if modes:
        (last,), (rows,) = switches, modes
        events = jax.tree.map(lambda saved: saved[0], last.modes.events)
        taken = taken_at(problem.args, ts, rows, q)
        holding = shown_at(rows.mode), shown_at(taken), in_order(events, valid)
    own = jax.tree.map(shown_at, own)
    return Solution(times, q, qd, stats, result, own, *holding)


def last_switched(inputs: Inputs, keywords: Settings) -> Array:
    """Returns which switching functions switched where a motion ended, (switch,).

    In the order of the elements; guards of modes are the last ones.
    """
    keywords = keywords | {"adjoint": diffrax.ForwardMode()}
    problem = _prepare(inputs, derivatives=False, plain=False)
    control = _control(problem, keywords, derivatives=False, tangents=None)
    ends = _solve(problem, control, keywords).ys
    assert ends is not None  # because of saveat
    switching = ends[1][1]
    return (switching.after != switching.sides)[0]


def _differentiable(
    solver: diffrax.AbstractSolver, adjoint: diffrax.AbstractAdjoint
) -> diffrax.AbstractSolver:
    """Returns the solver with loops that the adjoint can differentiate.

    diffrax does this itself, except for a solver inside a wrapper.
    """
    if isinstance(solver, LoopedDopri8):
        return LoopedDopri8(replayed=not isinstance(adjoint, diffrax.ForwardMode))
    kinds = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}
    kind = kinds.get(type(adjoint))
    if kind is None or not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


def faults(inputs: Inputs, times: bool = True) -> list[Array]:
    """Returns whether times, start, linkage and each element are at fault.

    `times`: whether those are looked at, too; those of a plain call may repeat the last
    one.
    """
    linkage, state0, ts, _, forces, _ = inputs
    growth = jnp.diff(ts)
    increasing = ((growth > 0) & (growth < jnp.inf)).all() | (not times)
    finite = (jnp.isfinite(state0.q) & jnp.isfinite(state0.qd)).all()
    q0 = jnp.asarray(state0.q)
    place = agrees(forces, ts[0], q0, linkage) & within_stops(forces, q0, linkage)
    arm = constant((linkage, ts))
    fit = [jnp.asarray(e.possible() & constant(e).fits(*arm)) for e in forces]
    return [~fine for fine in (increasing, finite & place, possible(linkage), *fit)]
