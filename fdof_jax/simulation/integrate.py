"""Integrates the equations of motion: prepares, controls, solves and reads."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.checks import refusal
from ..base.known_values import known_array
from ..base.trees import constant
from ..forces.element import Element, OwnStates
from ..forces.joints import EffortHistory
from ..forces.reset import Reset
from ..linkage.linkage import Linkage, possible, without_fixed
from ..steps import loop
from ..steps.derivative_control import ProbeJudge, TangentJudge
from ..steps.dopri8 import ScheduledDopri8
from ..steps.events import events_of
from ..steps.judge import Judge, JudgeState
from ..steps.landing import Clock, Landing, clearance
from ..steps.looped_dopri8 import LoopedDopri8
from ..steps.term import Integrated
from ..steps.tolerances import default_controller, error_control_of, with_tolerances
from .arrays import in_arrays
from .events import in_order
from .formulation import clocks_apart, joints_at, known_times, start_of, term_of
from .holding import changes, leaves_prescribed, taken_at, within_stops
from .prescribed import agrees
from .sampler import sampler_of
from .solution import Solution
from .until import CONDITIONS, End, conditions_in
from .vector_field import args_of, initial_own, own_states

RESULTS: Any = diffrax.RESULTS
# What `solve_options` returns; sweeps add `lanes` (see `loop.Scheme`).
Settings = dict[str, Any]


class Inputs(NamedTuple):
    """The arguments that determine a motion, as `simulate` gets them.

    - `known_ef`: existence factors that the program may contain, or None.
    """

    linkage: Linkage
    state0: Any  # a State of arrays
    ts: Array | np.ndarray
    own0: OwnStates | None
    forces: tuple[Element, ...]
    known_ef: tuple[float, ...] | None = None


class _Motion(NamedTuple):
    """A motion to compute.

    - `valid`: whether the inputs are; stand-ins replace others.
    - `first`: positions and velocities at the first time.
    - `jumps`, `clocks`: known times of jumps.
    - `joints(t, y)`: reads positions, velocities and the elements' own states.
    """

    valid: Array
    first: tuple[Array, Array]
    problem: loop.Problem
    jumps: Array | None
    clocks: tuple[Clock, ...]
    joints: Callable[[Array, Integrated], tuple[Array, Array, OwnStates]]


def integrate(
    inputs: Inputs,
    keywords: Settings,
    derivatives: bool = False,
    plain: bool = False,
    tangents: TangentJudge | None = None,
) -> Solution:
    """Integrates one motion, by default with `LoopedDopri8`.

    `derivatives`: whether steps suit accurate derivatives. `plain`: whether outside of
    transformations; the last time may then repeat. `tangents`: judges tangents that the
    caller maps along `TANGENTS`.
    """
    motion = _prepare(inputs, derivatives, plain, bool(tangents and tangents.tolerance))
    scheme = _scheme(motion, keywords, derivatives, tangents)
    end = loop.solve(motion.problem, scheme)
    solution = _read(inputs, motion, end, keywords)
    if not conditions_in(inputs.forces):
        return solution
    return _with_end(solution, motion, scheme.events, end)


def _prepare(
    inputs: Inputs, derivatives: bool, plain: bool, searching: bool = False
) -> _Motion:
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
    term, start = term_of(forces), start_of(args, qd0, own)

    def joints(t, y):
        return *joints_at(args, t, y), own_states(args, y)

    begin = start if term.settle is None else term.settle(ts[0], start, args)
    q, qd, _ = joints(ts[0], begin)  # after an impact there, like all that follows
    known = known_times(args)
    of_problem = term, start, args
    # Loops of few motions compile and run faster in arrays.
    if plain and not derivatives or searching:
        of_problem = in_arrays(*of_problem)
    problem = loop.Problem(*of_problem, ts)
    return _Motion(valid & finite, (q, qd), problem, *known, joints)


def _scheme(
    motion: _Motion, keywords, derivatives: bool, tangents: TangentJudge | None
) -> loop.Scheme:
    given = keywords["stepsize_controller"]  # by the user
    controller = given or default_controller()
    method = _differentiable(keywords["solver"] or LoopedDopri8(), keywords["adjoint"])
    method = with_tolerances(method, controller)
    judge = events = landing = None
    term, start, args, ts = motion.problem
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        own_tolerance = given is not None
        of_derivatives = tangents
        if derivatives and not tangents:
            of_derivatives = _probe(term, method, own_tolerance)
        watches = not isinstance(method, ScheduledDopri8)  # which finds it itself
        control = error_control_of(controller)
        judge = Judge(control, term, watches, of_derivatives)
        met = [e for e in args.forces if isinstance(e, CONDITIONS)]
        conditions = [(isinstance(e, Reset), e.direction) for e in met]
        events = events_of(term, ts, start, args, conditions, derivatives)
        lands = events is not None or motion.jumps is not None
    else:
        lands = False
        _check_constant_steps(args.forces, controller)
    if lands or motion.clocks:
        jumps = None if motion.jumps is None else jnp.asarray(motion.jumps, ts.dtype)
        landing = Landing(jumps, motion.clocks, clearance(ts), events is not None)
    return loop.Scheme(
        method=method,
        controller=controller,
        dt0=keywords["dt0"],
        judge=judge,
        events=events,
        landing=landing,
        adjoint=keywords["adjoint"],
        max_steps=keywords["max_steps"],
        meter=keywords["progress_meter"],
        lanes=keywords.get("lanes"),  # of sweeps
    )


def _probe(
    term: Any, method: diffrax.AbstractSolver, own_tolerance: bool
) -> ProbeJudge | None:
    """Returns what judges derivatives, None if nothing does.

    A user's tolerances let implicit methods leave fast motions unresolved; a probe
    would resolve them.
    """
    if own_tolerance and isinstance(method, diffrax.AbstractImplicitSolver):
        return None
    has_tableau = isinstance(method, ScheduledDopri8 | diffrax.AbstractRungeKutta)
    # Of other methods derivatives are judged as if they were by Heun's.
    tableau: Any = method.tableau if has_tableau else diffrax.Heun.tableau
    return ProbeJudge(term, tableau)


def _check_constant_steps(forces: tuple[Element, ...], controller: object) -> None:
    """Raises ValueError for elements that need adaptive steps."""
    why = None
    # Fixed steps may step over the kinks of an `EffortHistory`, but not over jumps.
    jumping = (e for e in forces if not isinstance(e, EffortHistory))
    if any(e.jump_ts is not None for e in jumping):
        why = "declare times at which they jump (jump_ts)"
    elif conditions_in(forces):
        why = "come with a condition that ends the motion (until)"
    elif changes(forces):
        why = "hold joints, take payloads or reset the state"
    elif sampler_of(forces) and not isinstance(controller, diffrax.ConstantStepSize):
        why = "are sampled (or a ConstantStepSize)"
    if why is not None:
        expected = f"an adaptive one, as forces {why}"
        raise refusal("stepsize_controller", expected, controller)


def _read(
    inputs: Inputs, motion: _Motion, end: loop.Attempt, keywords: Settings
) -> Solution:
    linkage, state0, times, *_ = inputs
    valid, ts = motion.valid, motion.problem.ts
    states, modes, sampled = end.rows
    q, qd, own = jax.vmap(motion.joints)(ts, states)

    def shown_at(a):
        """Replaces infinity by NaN, at times that were not reached."""
        return jnp.where(jnp.isinf(a) | ~valid, jnp.nan, a)

    # The start is saved with the first step, after any impact there.
    saved = None if modes is None else jnp.isfinite(qd[0]) & valid

    def from_start(rows, start, given):
        """Returns rows that begin with the start, or what was given if invalid."""
        first = jnp.where(valid, start, given)
        if saved is not None:
            first = jnp.where(saved, rows[0], first)
        return shown_at(rows).at[0].set(first)

    given = (without_fixed(linkage, value) for value in state0)
    q, qd = map(from_start, (q, qd), motion.first, given)
    # Constant steps go on when the state is no longer finite, and a prescribed motion
    # may not be finite itself.
    reached, result = jnp.minimum(end.t, ts[-1]), end.result
    lost = (ts <= reached) & ~jnp.isfinite(q + qd).all(axis=1)
    last_finite = ts[jnp.maximum(jnp.argmax(lost) - 1, 0)]
    reached = jnp.where(lost.any(), last_finite, reached)
    unsaid = lost[-1] & (result == RESULTS.successful)
    result = RESULTS.where(valid & ~unsaid, result, RESULTS.nonfinite)
    stats: dict[str, Any] = {
        "num_steps": end.steps,
        "num_accepted_steps": end.accepted,
        "num_rejected_steps": end.steps - end.accepted,
        "max_steps": keywords["max_steps"],
        "time_reached": jnp.where(valid, reached, times[0]),
    }
    if isinstance(end.judged, JudgeState):
        stats["accuracy"] = jnp.finfo(q.dtype).eps * end.judged.loss
    if end.switches is not None:
        stats |= end.switches.facts
    holding: Any = ()  # modes, energy taken, events
    if modes is not None:
        assert end.switches is not None  # which guard them
        taken = taken_at(motion.problem.args, ts, modes, q)
        events = in_order(end.switches.modes.events, valid)
        holding = shown_at(modes.mode), shown_at(taken), events
    own = jax.tree.map(shown_at, own)
    tau = None if sampled is None else shown_at(sampled.command)
    if tau is not None and motion.problem.args.lead is not None:
        # By a clock that is behind, rows are saved before the samples at their times.
        tau = jnp.append(tau[1:], tau[-1:], axis=0)
    return Solution(jnp.asarray(times), q, qd, stats, result, own, *holding, tau=tau)


def _with_end(
    solution: Solution, motion: _Motion, events: Any, end: loop.Attempt
) -> Solution:
    """Returns a solution with its `End`."""
    switches: Any = end.switches
    args = motion.problem.args._replace(sampled=end.sampled)
    t, y = events.at_end(end.t, end.y, args, switches)
    q, qd, _ = motion.joints(t, y)
    ended = (switches.ended >= 0) & motion.valid
    found = End(
        t=jnp.where(ended, t, solution.ts[-1]),
        q=jnp.where(ended, q, solution.q[-1]),
        qd=jnp.where(ended, qd, solution.qd[-1]),
        condition=jnp.where(ended, switches.ended, -1),
    )
    return dataclasses.replace(solution, end=found)


def last_switched(inputs: Inputs, keywords: Settings) -> Array:
    """Returns which switching functions switched where a motion ended, (switch,).

    Guards of modes come last.
    """
    keywords = keywords | {"adjoint": diffrax.ForwardMode()}
    motion = _prepare(inputs, derivatives=False, plain=False)
    scheme = _scheme(motion, keywords, derivatives=False, tangents=None)
    switches = loop.solve(motion.problem, scheme).switches
    assert switches is not None  # of which a motion has too many
    return switches.after != switches.sides


def _differentiable(
    solver: diffrax.AbstractSolver, adjoint: diffrax.AbstractAdjoint
) -> diffrax.AbstractSolver:
    """Returns the solver with loops that the adjoint can differentiate."""
    if isinstance(solver, LoopedDopri8):
        return LoopedDopri8(replayed=not isinstance(adjoint, diffrax.ForwardMode))
    kinds = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}
    kind = kinds.get(type(adjoint))
    if kind is None or not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


def faults(inputs: Inputs, times: bool = True) -> list[Array]:
    """Returns whether times, start, linkage and each element are at fault.

    `times`: whether to check the times; the last one of a plain call may repeat.
    """
    linkage, state0, ts, _, forces, _ = inputs
    growth = jnp.diff(ts)
    increasing = ((growth > 0) & (growth < jnp.inf)).all() | (not times)
    finite = (jnp.isfinite(state0.q) & jnp.isfinite(state0.qd)).all()
    q0 = jnp.asarray(state0.q)
    place = agrees(forces, ts[0], q0, linkage) & within_stops(forces, q0, linkage)
    place &= leaves_prescribed(forces, linkage)
    arm = constant((linkage, ts))
    fit = [jnp.asarray(e.possible() & constant(e).fits(*arm)) for e in forces]
    return [~fine for fine in (increasing, finite & place, possible(linkage), *fit)]
