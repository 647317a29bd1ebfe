"""The loop of an integration: steps of diffrax's methods, taken by hand.

diffrax documents this way of stepping: its methods take the steps, and its controllers
choose their lengths. Between the two stands what `diffeqsolve` has no place for: steps
end where something happens, and are judged by more than their error.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from .dopri8 import Arguments, Integrated, ScheduledTerm, chosen, constant
from .events import Events, Switches
from .judge import Judge, Step
from .landing import Landing, NextStep
from .tolerances import Controller, Shortening, error_control_of, with_error_control

RESULTS: Any = diffrax.RESULTS
# A step that would end within so many units of rounding of the end of the run ends
# there: dense output of a shorter one would be rounding alone.
_NEAR_END = 100
# A lane stops once it has taken `_SLACK` times as many steps as it had taken when
# `_MOST` of the lanes were done.
_SLACK, _MOST = 1.5, 7 / 8


class Problem(NamedTuple):
    """An initial value problem.

    - `ts`: output times, the first and the last one of the run.
    """

    term: ScheduledTerm
    start: Integrated
    args: Arguments
    ts: Array


class Stepping(NamedTuple):
    """How steps are taken.

    - `method`, `controller`: those of diffrax. `dt0`: length of the first step, or None
      for the controller's estimate.
    - `judge`, `events`, `landing`: None for constant steps; the last two also if
      nothing happens in the run.
    - `adjoint`: which derivatives the loops can have.
    - `lanes`: the axis of a batch in which a lane gives up when most others are long
      done, or None.
    """

    method: Any
    controller: Controller
    dt0: Array | float | None
    judge: Judge | None
    events: Events | None
    landing: Landing | None
    adjoint: diffrax.AbstractAdjoint
    most_steps: Any  # int | Array | None
    meter: diffrax.AbstractProgressMeter
    lanes: str | None


class Attempt(NamedTuple):
    """The state of the loop: a step to try, and what is known before it.

    - `t`, `end`: where the step begins and is to end [s].
    - `y`: the state at `t`, before what happens there; `jumped`: whether something may
      happen, None if it never does.
    - `method`, `controller`, `wrappers`: states of the method, of the controller that
      judges errors, and of those around it.
    - `probe`: of derivatives (see `OfLinearised`); `loss`: the largest loss of accuracy
      in steps so far.
    - `landing`, `switches`: states of `Landing` and of `Events`, None without them.
    - `rows`: states at output times, infinite at those to come; `saved`: how many are
      there.
    - `meter`: state of the progress meter.
    - `steps`, `accepted`: numbers of steps tried and kept; `typical`: how many steps
      most lanes took (see `Stepping.lanes`).
    - `result`: the first failure, if any.
    """

    t: Array
    end: Array
    y: Integrated
    jumped: Array | None
    method: PyTree
    controller: PyTree
    wrappers: PyTree
    probe: PyTree
    loss: Array | None
    landing: PyTree
    switches: Switches | None
    rows: PyTree
    saved: Array
    meter: PyTree
    steps: Array
    accepted: Array
    typical: Array | None
    result: diffrax.RESULTS


class _Planned(diffrax.AbstractStepSizeController):
    """Stands for a controller within others, which change the answer that it gives."""

    answer: Any

    def wrap(self, direction):
        return self

    def init(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.answer

    def adapt_step_size(self, *arguments):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.answer


def solve(problem: Problem, stepping: Stepping) -> Attempt:
    """Integrates a problem; returns the state of the loop at its end.

    A failure is its `result`.
    """
    term, _, args, ts = problem
    method, _, _, judge, events, landing, *_, meter, lanes = stepping
    controller = stepping.controller.wrap(1)
    order = method.error_order(term)
    last = ts[-1] if landing is None else landing.end_of_run(ts)
    kind, checkpoints = _kind_of(stepping.adjoint, stepping.most_steps)
    near_end = last - _NEAR_END * jnp.finfo(ts.dtype).eps * jnp.abs(last)

    def wrapped(planned: tuple) -> Controller:
        return with_error_control(lambda _: _Planned(planned), controller)

    def advance(a: Attempt) -> Attempt:
        # What happens where the last step ended?
        y0, own, begun, jumped = a.y, args, None, a.jumped
        jumped = False if jumped is None else jumped
        if events is not None:
            y0, begun = events.crossed(a.t, a.y, a.switches, jumped)
            own = args._replace(sides=begun.sides, modes=begun.modes)

        # A step
        y1, error, dense, of_method, failed = method.step(
            term, a.t, a.end, y0, own, a.method, jumped
        )
        error = jax.tree.map(lambda e: jnp.where(jnp.isnan(e), jnp.inf, e), error)
        path = method.interpolation_cls(t0=a.t, t1=a.end, **dense)
        found, switches = None, a.switches
        if events is not None:
            y1 = events.kept(begun, y1, y0)
            found, switches = events.located(a.t, a.end, path, own, begun, a.switches)

        # Is it accurate, for the size of the state before? How long is the next one?
        step, probe, loss = Step(a.t, a.end, a.y, y1, own), a.probe, a.loss
        arguments = a.t, a.end, a.y, y1, own, error, order
        if judge is None:
            plan = controller.adapt_step_size(*arguments, a.controller)
            *plan, of_controller, result = plan
            next_step = NextStep(*plan, result)
        else:
            next_step, of_controller, probe, loss, result = judge(
                step, error, order, a.controller, a.probe, a.loss
            )

        # Where is it to end?
        of_landing = a.landing
        if landing is not None:
            next_step, resumes, of_landing = landing.after(
                a.t, a.end, found, next_step, a.landing
            )
            of_controller = chosen(resumes, a.controller, of_controller)
        if judge is not None:
            probe = judge.probed(next_step, probe, a.probe, y1)
            unhealthy = result != RESULTS.successful
            next_step = next_step._replace(
                result=RESULTS.where(unhealthy, result, next_step.result)
            )
        of_wrappers = a.wrappers
        if a.wrappers is not None:
            plan = *next_step[:4], (), next_step.result
            *plan, of_wrappers, result = wrapped(plan).adapt_step_size(
                *arguments, a.wrappers
            )
            next_step = NextStep(*plan, result)
        keep, t, end, jumped, result = next_step
        t = jnp.minimum(t, last)
        halfway = jnp.where(keep, last, t + (last - t) / 2)
        end = jnp.where(end > near_end, halfway, end)

        # Output
        def waiting(output):
            saved, _ = output
            return keep & (saved < len(ts)) & (ts[saved] <= a.end)

        def saving(output):
            saved, rows = output
            row = _row(path.evaluate(ts[saved]), begun)
            put = lambda value, rows: rows.at[saved].set(value)
            return saved + 1, jax.tree.map(put, row, rows)

        saved, rows = eqx.internal.while_loop(
            waiting,
            saving,
            (a.saved, a.rows),
            kind=kind,
            max_steps=len(ts),
            buffers=lambda output: output[1],
            checkpoints=len(ts),
        )
        failed = RESULTS.where(keep, failed, RESULTS.successful)
        result = RESULTS.where(failed == RESULTS.successful, result, failed)
        steps, typical = a.steps + 1, a.typical
        if typical is not None:
            behind, typical = _behind(steps, typical, lanes)
            gives_up = behind & (result == RESULTS.successful)
            result = RESULTS.where(gives_up, RESULTS.max_steps_reached, result)
        progress = constant((t - ts[0]) / (last - ts[0]))
        return Attempt(
            t=t,
            end=end,
            y=chosen(keep, y1, a.y),
            jumped=None if a.jumped is None else jnp.where(keep, jumped, a.jumped),
            method=chosen(keep, of_method, a.method),
            controller=of_controller,
            wrappers=of_wrappers,
            probe=probe,
            loss=chosen(keep, loss, a.loss),
            landing=of_landing,
            switches=chosen(keep, switches, a.switches),
            rows=rows,
            saved=saved,
            meter=meter.step(a.meter, progress),
            steps=steps,
            accepted=a.accepted + keep,
            typical=typical,
            result=result,
        )

    def unfinished(a: Attempt) -> Array:
        return (a.t < last) & (a.result == RESULTS.successful)

    def going(a: Attempt) -> Array:
        most = stepping.most_steps
        return unfinished(a) if most is None else unfinished(a) & (a.steps < most)

    end = eqx.internal.while_loop(
        going,
        advance,
        _first_attempt(problem, stepping, controller, wrapped, last),
        kind=kind,
        max_steps=None if kind == "lax" else stepping.most_steps,
        buffers=lambda a: a.rows,
        checkpoints=checkpoints,
    )
    meter.close(end.meter)
    spent = RESULTS.where(unfinished(end), RESULTS.max_steps_reached, end.result)
    return end._replace(result=spent)


def _first_attempt(
    problem: Problem, stepping: Stepping, controller: Controller,
    wrapped: Callable[[tuple], Controller], last: Array,
) -> Attempt:  # fmt: skip
    """Returns the state of the loop before the first step."""
    (term, y0, args, ts), t0 = problem, problem.ts[0]
    method, _, dt0, judge, events, landing, *_, meter, lanes = stepping
    switches, jumped = None, None
    if events is not None:
        switches = events.start(t0)
        args = args._replace(sides=switches.sides, modes=switches.modes)
    arguments = term, t0, last, y0, dt0, args
    others = method.func, method.error_order(term)
    if judge is None:
        judging, probe = controller, ()
    else:
        judging, probe = error_control_of(controller), judge.start(y0)
        arguments = constant(arguments)
    end, of_controller = judging.init(*arguments, *others)
    if judge is not None:
        end, of_controller = constant((end, of_controller))
    of_landing, of_wrappers = None, None
    if landing is not None:
        end, of_landing = landing.start(t0, last, end)
    if judging is not controller:
        plan = wrapped((end, ()))
        end, of_wrappers = plan.init(*arguments, *others)
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
        method=constant(method.init(term, t0, end, y0, args)),
        controller=of_controller,
        wrappers=of_wrappers,
        probe=probe,
        loss=None if judge is None else jnp.zeros_like(t0),
        landing=of_landing,
        switches=switches,
        rows=jax.tree.map(rows, _row(y0, switches)),
        saved=none,
        meter=meter.init(),
        steps=none,
        accepted=none,
        typical=None if lanes is None else none,
        result=RESULTS.successful,
    )


def _row(y: Integrated, at: Any) -> PyTree:
    """Returns what is saved of a state: itself, and the modes if joints are held."""
    if at is None or at.modes is None:
        return y, None
    return y, at.modes._replace(events=None)


def _never_jumps(controller: Controller) -> bool:
    """Returns whether a controller never says that rates jump after a step."""
    fixed = diffrax.ConstantStepSize, diffrax.StepTo
    return type(controller) in (diffrax.PIDController, Shortening, *fixed)


def _behind(steps: Array, typical: Array, lanes: str) -> tuple[Array, Array]:
    """Returns whether a lane has fallen behind most others, and `Attempt.typical`."""
    # Once a lane is done its state is frozen, so that its count falls behind.
    done = steps < jax.lax.pmax(steps, lanes)
    most = jax.lax.pmean(done.astype(float), lanes) >= _MOST
    typical = jnp.where(most & (typical == 0), steps, typical)
    return (typical > 0) & (steps >= _SLACK * typical), typical


def _kind_of(adjoint: diffrax.AbstractAdjoint, most_steps: Any) -> tuple[Any, Any]:
    """Returns the kind of equinox's loops for an adjoint, and how many checkpoints."""
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        if most_steps is not None or adjoint.checkpoints is not None:
            return "checkpointed", adjoint.checkpoints
    elif isinstance(adjoint, diffrax.DirectAdjoint) and most_steps is not None:
        return "bounded", None
    return "lax", None
