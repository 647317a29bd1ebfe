"""The loop of an integration: steps of diffrax's methods, taken by hand.

Unlike those of `diffeqsolve`, steps end where something happens, and are judged by more
than their error. A step only finds what happens at its end; the next one does it, anew
each time it is tried: a step finds a bounce, and the next one begins with the impact.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from ..base.checks import refusal
from ..base.trees import chosen, constant
from .dopri8 import DenseOutput
from .events import EventHandler, SwitchState
from .judge import Judge, StepEnds, without_nan
from .landing import NEAR_END, Found, Landing, NextStep
from .term import Arguments, Integrated, ScheduledTerm
from .tolerances import Controller, EagerController, with_error_control

RESULTS: Any = diffrax.RESULTS
# A lane gives up once it has taken `_SLACK` times as many steps as it had taken when
# the majority of lanes were done.
_SLACK, _MAJORITY = 1.5, 7 / 8


class Problem(NamedTuple):
    """An initial value problem over the output times `ts`.

    Of `args`, the branches, modes and samples in force are those of the loop's state.
    """

    term: ScheduledTerm
    start: Integrated
    args: Arguments
    ts: Array


class Scheme(NamedTuple):
    """The numerical scheme: method, control and ends of steps.

    - `dt0`: length of the first step, None for the controller's estimate.
    - `judge`: None if the controller judges no errors, as with constant steps. Then
      `events` is None too: nothing is located, and branches are those of each instant.
    - `events`: None if nothing switches; `landing`: None without events or known times.
    - `lanes`: the axis of a batch in which a lane gives up when most are long done.
    """

    method: Any
    controller: Controller
    dt0: Array | float | None
    judge: Judge | None
    events: EventHandler | None
    landing: Landing | None
    adjoint: diffrax.AbstractAdjoint
    max_steps: Any  # int | Array | None
    meter: diffrax.AbstractProgressMeter
    lanes: str | None


class Attempt(NamedTuple):
    """The state of the loop: a step to try, and what is known before it.

    - `t`, `end`: where the step begins and is to end [s].
    - `y`: the state at `t`, before what happens there.
    - `jumped`: whether rates may jump there, because the step before ended at a known
      time or a switch, or the controller says so; None if they never do.
    - `method`, `landing`: states of the method and of `Landing`.
    - `judged`: state of `Judge`, or else of the controller; `wrappers`: of controllers
      around the one that judges errors, such as diffrax's `ClipStepSizeController`.
    - `switches`: which branches and modes hold, and what happens at `t`; `sampled`: the
      state of a controller that samples. Each is None without any.
    - `rows`: states at output times, infinite at those to come; `saved`: how many are
      there.
    - `steps`, `accepted`: numbers of steps tried and kept; `typical`: how many this
      lane had tried when the majority were done, 0 before.
    - `result`: the first failure, if any.
    """

    t: Array
    end: Array
    y: Integrated
    jumped: Array | None
    method: PyTree
    judged: Any  # JudgeState | PyTree
    wrappers: PyTree
    landing: PyTree
    switches: Any  # SwitchState | None
    sampled: PyTree
    rows: PyTree
    saved: Array
    meter: PyTree
    steps: Array
    accepted: Array
    typical: Any  # Array | None
    result: diffrax.RESULTS


class _StepResult(NamedTuple):
    """A step that was taken, whether it is kept or not.

    - `y1`: the state at its end; `path`: there and between.
    - `error`: by the method, a `dopri8.Estimate` if it has checked the end too.
    - `failed`: result of the method; `found`: what happens in the step.
    """

    args: Arguments
    y1: Integrated
    path: diffrax.AbstractLocalInterpolation
    error: PyTree
    method: PyTree
    failed: diffrax.RESULTS
    found: Found | None
    switches: SwitchState | None


class _FixedAnswer(diffrax.AbstractStepSizeController):
    """Stands for a controller within others, which change its answer."""

    answer: Any

    def wrap(self, direction):
        return self

    def init(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.answer

    def adapt_step_size(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.answer


def solve(problem: Problem, scheme: Scheme) -> Attempt:
    """Integrates a problem; returns the last state of the loop, with any failure."""
    ts, landing, max_steps = problem.ts, scheme.landing, scheme.max_steps
    last = ts[-1] if landing is None else landing.end_of_run(ts)
    kind, checkpoints = _kind_of(scheme)
    # Times add up with rounding, which might leave a step of an ulp at the end.
    near_end = last - NEAR_END * jnp.finfo(ts.dtype).eps * jnp.abs(last)

    def advance(a: Attempt) -> Attempt:
        taken = _taken(problem, scheme, a)
        plan, judged, wrappers, of_landing = _planned(problem, scheme, a, taken)
        saved, rows = _saved(ts, kind, a, taken, plan.keep)
        t = plan.t0
        # A step that is tried again keeps the end that it was given.
        at_end = plan.keep & (plan.t1 > near_end)
        # A method may fail in a step that is too long; only one that is kept counts.
        result = RESULTS.where(plan.keep, taken.failed, RESULTS.successful)
        result = RESULTS.where(result == RESULTS.successful, plan.result, result)
        steps, typical = a.steps + 1, a.typical
        if scheme.lanes is not None:
            result, typical = _together(steps, typical, result, scheme.lanes)
        kept = lambda after, before: chosen(plan.keep, after, before)
        return Attempt(  # all else follows from the plan, which says what is kept
            t=t,
            end=jnp.where(at_end, last, jnp.minimum(plan.t1, last)),
            y=kept(_after_gap(problem.term, scheme, a, taken, plan), a.y),
            jumped=None if a.jumped is None else kept(plan.jumped, a.jumped),
            method=kept(taken.method, a.method),
            judged=judged,
            wrappers=wrappers,
            landing=of_landing,
            switches=kept(taken.switches, a.switches),
            sampled=kept(taken.args.sampled, a.sampled),
            rows=rows,
            saved=saved,
            meter=scheme.meter.step(a.meter, constant((t - ts[0]) / (last - ts[0]))),
            steps=steps,
            accepted=a.accepted + plan.keep,
            typical=typical,
            result=result,
        )

    def unfinished(a: Attempt) -> Array:
        goes_on = (a.t < last) & (a.result == RESULTS.successful)
        if a.switches is None or a.switches.ended is None:
            return goes_on
        return goes_on & (a.switches.ended < 0)  # no condition has ended it

    final = eqx.internal.while_loop(
        lambda a: unfinished(a) & (True if max_steps is None else a.steps < max_steps),
        advance,
        _first_attempt(problem, scheme, last),
        kind=kind,
        # As data it may change without a new program; other kinds need it to know how
        # much memory the backward pass takes.
        max_steps=None if kind == "lax" else max_steps,
        # Rows are written once and not read: a backward pass need not store them.
        buffers=lambda a: a.rows,
        checkpoints=checkpoints,
    )
    if kind == "lax" and not isinstance(scheme.adjoint, diffrax.ForwardMode):
        final = eqx.internal.nondifferentiable_backward(
            final,
            msg="reverse-mode differentiation of simulate needs an upper bound of its "
            "steps (max_steps) or, with RecursiveCheckpointAdjoint, a number of "
            "checkpoints.",
            symbolic=True,
        )
    scheme.meter.close(final.meter)
    result = RESULTS.where(unfinished(final), RESULTS.max_steps_reached, final.result)
    return final._replace(result=result)


def _first_attempt(problem: Problem, scheme: Scheme, last: Array) -> Attempt:
    (term, y0, args, ts), t0 = problem, problem.ts[0]
    method, controller, judge = scheme.method, scheme.controller, scheme.judge
    events, landing = scheme.events, scheme.landing
    switches = of_landing = wrappers = jumped = None
    end: Any
    if events is not None:
        switches = events.start(t0, args)
        args = args._replace(sides=switches.sides, modes=switches.modes)
    order = method.error_order(term)
    run: Any = term, t0, last, y0, scheme.dt0, args, method.func, order
    if judge is None:
        end, judged = controller.wrap(1).init(*run)
    else:
        # Up to the tolerance, a motion does not depend on the lengths of its steps.
        run = constant(run)
        end, judged = judge.start(run, y0)
    if landing is not None:  # of no length, if it must find what holds at `t0`
        end, of_landing = landing.start(t0, last, end)
    if judge is not None and controller is not judge.controller:
        end, wrappers = _around((end, ()), controller).init(*run)
    if landing is not None or not _never_jumps(controller):
        jumped = jnp.array(False)
    end = jnp.minimum(end, last)
    # A run of no length takes no step.
    unsaved = lambda x: jnp.where(t0 < last, jnp.inf, x)
    rows = lambda x: jnp.broadcast_to(unsaved(x), (len(ts), *jnp.shape(x)))
    none = jnp.zeros((), int)
    return Attempt(
        t=t0,
        end=end,
        y=y0,
        jumped=jumped,
        # Zeros or a guess, on which the motion does not depend.
        method=constant(method.init(term, t0, end, y0, args)),
        judged=judged,
        wrappers=wrappers,
        landing=of_landing,
        switches=switches,
        sampled=args.sampled,
        rows=jax.tree.map(rows, _row(y0, args)),
        saved=none,
        meter=scheme.meter.init(),
        steps=none,
        accepted=none,
        typical=None if scheme.lanes is None else none,
        result=RESULTS.successful,
    )


def _taken(problem: Problem, scheme: Scheme, a: Attempt) -> _StepResult:
    """Does what happens where a step begins, and takes the step."""
    term, _, args, _ = problem
    method, events = scheme.method, scheme.events
    y0, regime, found, switches = a.y, None, None, None
    jumped: Any = False if a.jumped is None else a.jumped
    stale = jumped  # whether rates that the method keeps are out of date
    args = args._replace(sampled=a.sampled)
    if events is not None:
        y0, regime = events.crossed(a.t, a.y, args, a.switches, jumped)
        args = args._replace(sides=regime.sides, modes=regime.modes)
    if term.settle is not None:  # by an impact, to velocities that are prescribed
        y0, stale = term.settle(a.t, y0, args), True
    # A controller measures the state after impacts. Its commands change accelerations.
    if term.sample is not None:
        sampled, changed = term.sample(a.t, y0, args)
        args, stale = args._replace(sampled=sampled), stale | changed
    y1, error, dense, of_method, failed = method.step(
        term, a.t, a.end, y0, args, a.method, stale
    )
    path = method.interpolation_cls(t0=a.t, t1=a.end, **dense)
    if events is not None:
        assert regime is not None
        y1 = events.held_still(regime, y1, y0)
        # Looked for in a step that its error may reject, too: whether it is kept is
        # known later, and a batch computes both anyway.
        found, switches = events.located(a.t, a.end, path, args, regime, a.switches)
    return _StepResult(args, y1, path, error, of_method, failed, found, switches)


def _planned(
    problem: Problem, scheme: Scheme, a: Attempt, taken: _StepResult
) -> tuple[NextStep, Any, PyTree, PyTree]:
    """Returns the next step, and the states `judged`, `wrappers` and `landing`."""
    judge, landing, controller = scheme.judge, scheme.landing, scheme.controller
    of_landing, resumes = None, jnp.array(False)
    order = scheme.method.error_order(problem.term)
    # Tolerances are those of the state before what happens where the step begins.
    step, error = StepEnds(a.t, a.end, a.y, taken.y1, taken.args), taken.error
    if judge is None:
        return _planned_without_errors(scheme, a, step, without_nan(error), order)
    if error is None:
        raise refusal(
            "solver",
            "one that estimates errors, as steps are adaptive (diffrax.HalfSolver lets "
            "any do so)",
            scheme.method,
        )
    plan, judged, health = judge(step, error, order, a.judged)
    if landing is not None:
        plan, resumes, of_landing = landing.after(
            a.t, a.end, taken.found, plan, a.landing
        )
    judged = judge.before_next(judged, a.judged, plan, resumes, taken.y1)
    unhealthy = health != RESULTS.successful
    result = RESULTS.where(unhealthy, health, plan.result)
    wrappers = None
    if a.wrappers is not None:
        around = _around((*plan[:4], (), result), controller)
        *answer, wrappers, result = around.adapt_step_size(
            *step, error, order, a.wrappers
        )
        plan = NextStep(*answer, result)  # pyright: ignore[reportCallIssue]
    return plan._replace(result=result), judged, wrappers, of_landing


def _planned_without_errors(
    scheme: Scheme, a: Attempt, step: StepEnds, error: PyTree, order: float
) -> tuple[NextStep, Any, PyTree, PyTree]:
    *plan, judged, result = scheme.controller.wrap(1).adapt_step_size(
        *step, error, order, a.judged
    )
    plan, of_landing = NextStep(*plan, result), None  # pyright: ignore[reportCallIssue]
    if scheme.landing is not None:
        # The controller's own grid knows nothing of ends at known times.
        dt0: Any = scheme.dt0
        t0 = constant(plan.t0)  # `landing` adds the derivatives
        plan = plan._replace(t0=t0, t1=t0 + dt0)
        plan, _, of_landing = scheme.landing.after(a.t, a.end, None, plan, a.landing)
    return plan, judged, None, of_landing


def _after_gap(
    term: ScheduledTerm, scheme: Scheme, a: Attempt, taken: _StepResult, plan: NextStep
) -> Integrated:
    """Returns the state where the next step begins, before what happens there.

    Steps leave a gap at known times, which rounding must not pass (`clearance` in
    landing.py). The motion goes on meanwhile, as many such gaps would add up.
    """
    landing = scheme.landing
    if landing is None or not landing.timed:
        return taken.y1
    path, gap = taken.path, constant(plan.t0 - a.end)
    if isinstance(path, DenseOutput):
        rates = path.rate_at_end
    else:
        rates = term.vf(a.end, taken.y1, taken.args)
    over = lambda y, rate: y + jnp.where(gap > 0, gap * rate, 0)
    return jax.tree.map(over, taken.y1, rates)


def _around(answer: tuple, controller: Controller) -> Controller:
    """Returns a controller in which the one that judges errors gives an answer.

    It is in the order of diffrax's, as are the fields of `NextStep`.
    """
    return with_error_control(lambda _: _FixedAnswer(answer), controller.wrap(1))


def _saved(
    ts: Array, kind: Any, a: Attempt, taken: _StepResult, keep: Array
) -> tuple[Array, PyTree]:
    """Returns the number of output times so far, and the states there.

    One in a gap between steps is read from the path of the step after it.
    """

    def waiting(output):
        saved, _ = output
        return keep & (saved < len(ts)) & (ts[saved] <= a.end)

    def saving(output):
        saved, rows = output
        row = _row(taken.path.evaluate(ts[saved]), taken.args)
        put = lambda value, rows: rows.at[saved].set(value)
        return saved + 1, jax.tree.map(put, row, rows)

    return eqx.internal.while_loop(
        waiting,
        saving,
        (a.saved, a.rows),
        kind=kind,
        max_steps=len(ts),
        buffers=lambda output: output[1],
        checkpoints=len(ts),
    )


def _row(y: Integrated, args: Arguments) -> PyTree:
    """Returns what is saved at output times: no events or memories, read at the end."""
    modes, sampled = args.modes, args.sampled
    modes = None if modes is None else modes._replace(events=None)
    if sampled is not None:
        sampled = sampled._replace(memory=None, under_way=None)
    return y, modes, sampled


def _together(
    steps: Array, typical: Array, result: diffrax.RESULTS, lanes: str
) -> tuple[diffrax.RESULTS, Array]:
    """Returns a result that gives up if most other lanes are long done.

    Also returns `Attempt.typical`.
    """
    # Once a lane is done its state is frozen, so that its count falls behind.
    done = steps < jax.lax.pmax(steps, lanes)
    majority = jax.lax.pmean(done.astype(float), lanes) >= _MAJORITY
    typical = jnp.where(majority & (typical == 0), steps, typical)
    behind = (typical > 0) & (steps >= _SLACK * typical)
    gives_up = behind & (result == RESULTS.successful)
    return RESULTS.where(gives_up, RESULTS.max_steps_reached, result), typical


def _never_jumps(controller: Controller) -> bool:
    fixed = diffrax.ConstantStepSize, diffrax.StepTo
    return type(controller) in (diffrax.PIDController, EagerController, *fixed)


def _kind_of(scheme: Scheme) -> tuple[Any, int | None]:
    """Returns the kind of equinox's loops for an adjoint, and how many checkpoints."""
    adjoint, bounded = scheme.adjoint, scheme.max_steps is not None
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        if bounded or adjoint.checkpoints is not None:
            return "checkpointed", adjoint.checkpoints
    elif isinstance(adjoint, diffrax.DirectAdjoint) and bounded:
        return "bounded", None
    return "lax", None
