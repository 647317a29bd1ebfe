"""Simulates motions of a linkage, after checks of all arguments."""

from collections.abc import Callable, Sequence

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..base.checks import (
    increasing,
    instance,
    is_traced,
    plain,
    real_numbers,
    refusal,
    shown,
    single_precision,
    whole_number,
)
from ..base.known_values import in_numpy
from ..forces.element import Element, Forces, OwnStates, elements, elements_on, naming
from ..linkage.coordinates import State, real_state
from ..linkage.fields import check_values, jumps_at
from ..linkage.linkage import Linkage, check_linkage
from ..steps.tolerances import at_tolerances, check_method, with_longest, within_reach
from .failures import cause, check_arguments
from .holding import leaves_prescribed, within_stops
from .integrate import Inputs, Settings, faults
from .prescribed import agrees, prescribed
from .scene import Scene, accepts_scene
from .solution import OUTCOMES, Solution, outcome_numbers
from .solve import solve
from .until import conditions
from .vector_field import initial_states


def solve_options(
    *,
    solver: diffrax.AbstractSolver | None,
    rtol: ArrayLike | None,
    atol: ArrayLike | None,
    max_step: ArrayLike | None,
    stepsize_controller: diffrax.AbstractStepSizeController | None,
    dt0: ArrayLike | None,
    adjoint: diffrax.AbstractAdjoint,
    max_steps: int | None,
    throw: bool,
    progress_meter: diffrax.AbstractProgressMeter,
) -> Settings:
    """Checks `simulate`'s keywords; returns them without tolerances and `throw`."""
    if dt0 is not None:
        # As an array its value is no part of the program.
        dt0 = real_numbers("dt0", dt0, (), above=0)
    if max_steps is not None:
        most = np.iinfo(np.int32).max
        max_steps = whole_number("max_steps", max_steps, 1, most)
    loops = (
        diffrax.RecursiveCheckpointAdjoint,
        diffrax.ForwardMode,
        diffrax.DirectAdjoint,
    )
    if not isinstance(adjoint, loops):
        expected = "RecursiveCheckpointAdjoint or DirectAdjoint (reverse mode) or "
        raise refusal(
            "adjoint",
            f"{expected}ForwardMode; the gradients of BacksolveAdjoint are wrong on "
            "these problems, and other adjoints do not apply",
            adjoint,
        )
    instance("throw", throw, bool)
    instance("progress_meter", progress_meter, diffrax.AbstractProgressMeter)
    if solver is not None:
        instance("solver", solver, diffrax.AbstractSolver)
        check_method(solver)
    if not (rtol is atol is max_step is None):
        if stepsize_controller is not None:
            raise ValueError(
                "rtol, atol, max_step: expected none beside a stepsize_controller, "
                "which has its own (rtol, atol and dtmax of diffrax.PIDController), "
                f"got rtol={shown(rtol)}, atol={shown(atol)} and "
                f"max_step={shown(max_step)}."
            )
        stepsize_controller = at_tolerances(rtol, atol)
    if max_step is not None:
        stepsize_controller = with_longest(stepsize_controller, max_step)
    if stepsize_controller is not None:
        kind = diffrax.AbstractStepSizeController
        instance("stepsize_controller", stepsize_controller, kind)
        stepsize_controller = within_reach(stepsize_controller)
    return dict(
        solver=solver,
        stepsize_controller=stepsize_controller,
        dt0=dt0,
        adjoint=adjoint,
        max_steps=max_steps,
        progress_meter=progress_meter,
    )


def elements_at_door(linkage: Linkage, forces: Forces) -> tuple[Element, ...]:
    """Returns forces as elements; refuses wrong shapes and kinds, but no values."""
    adapted = elements_on(linkage, forces)
    for index, element in enumerate(adapted):
        place = f"forces[{index}]"
        with naming(place):
            jumps_at(place, in_numpy(element))
        single_precision(place, element)
    return adapted


def check_scene(name: str, scene: Scene) -> None:
    """Raises ValueError unless a scene's shapes and kinds can be simulated."""
    instance(name, scene, Scene)
    check_linkage(scene.linkage)
    real_state(f"{name}.state0", scene.state0, scene.linkage)
    elements(f"{name}.forces", scene.forces)
    elements_at_door(scene.linkage, scene.forces)


def check_elements(forces: Forces, linkage: Linkage, ts: Array) -> None:
    """Raises ValueError for elements whose known values are wrong or do not fit."""
    for index, element in enumerate(elements_at_door(linkage, forces)):
        place = f"forces[{index}]"
        if is_traced(linkage, ts, element):
            continue
        check_values(place, element)  # `equinox.tree_at` bypasses the constructor
        with naming(place):
            element.check(linkage, ts)
        if not in_numpy(element).possible():
            raise ValueError(
                f"{place}: expected values that its constructor accepts, got "
                f"{plain(eqx.tree_pformat(element, short_arrays=False))}."
            )


def check_start(
    forces: tuple[Element, ...], linkage: Linkage, state0: State, ts: Array
) -> None:
    """Raises ValueError unless known starts agree with references and stops."""
    if is_traced(linkage, state0, ts, forces):
        return
    q = jnp.asarray(state0.q)
    if not within_stops(forces, q, linkage):
        raise refusal("state0.q", "positions between the hard stops", q.tolist())
    motion = prescribed(forces)
    if not leaves_prescribed(forces, linkage):
        raise ValueError(
            "forces: expected no HardStops and no Brake at a joint whose motion is "
            "prescribed, because they cannot stop it (limits of -inf and inf count as "
            "none), got some."
        )
    if motion is not None and not agrees(forces, ts[0], q, linkage):
        begin, _ = motion.at(ts[0], linkage)
        expected = f"{begin.tolist()} at the joints whose motion is prescribed"
        raise refusal("state0.q", expected, q.tolist())


@accepts_scene
def simulate(
    linkage: Linkage,
    state0: State,
    ts: ArrayLike,
    forces: Forces = (),
    *,
    until: Callable | Sequence[Callable] | None = None,
    own0: OwnStates | None = None,
    solver: diffrax.AbstractSolver | None = None,
    rtol: ArrayLike | None = None,
    atol: ArrayLike | None = None,
    max_step: ArrayLike | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0: ArrayLike | None = 1e-3,
    adjoint: diffrax.AbstractAdjoint = diffrax.RecursiveCheckpointAdjoint(),
    max_steps: int | None = 65536,
    throw: bool = True,
    progress_meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter(),
) -> Solution:
    """Computes the motion of a linkage from `state0` at `ts[0]`, at the times `ts`.

    It solves the paper's masked equations (17)-(27), reduced. `simulate` is pure,
    differentiable in every array and batched by `jax.vmap`.

    **Arguments:**

    - `linkage`, `state0`: the arm, and its joint positions and velocities. A `Scene`
      may stand for linkage, state0 and forces: `simulate(scene, ts)`.
    - `ts`: increasing output times, of shape (time,) [s]. A step ends at the last time.
      States before it are interpolated and may be hundreds of times less exact;
      `diffrax.ClipStepSizeController` makes steps end at all of `ts`.
    - `forces`: a tuple of force elements `(t, q, qd, linkage) -> tau`.
    - `until`: one or several conditions that end the motion before `ts[-1]`: functions
      `(t, q, qd, linkage) -> number` that pass 0, or a `simulation.Until` with a
      direction. `Solution.end` is exact and has derivatives.
    - `own0`: initial states of the `StatefulElement`s, like a row of `Solution.own`; by
      default each element's `initial_state`.
    - `rtol`, `atol`: relative and absolute tolerance of a step, by default 1e-11 in
      float64 and 1e-5 in float32.
    - `max_step`: longest step [s], by default unlimited. Set it for efforts so brief
      that steps would pass over them.
    - `solver`, `stepsize_controller`, `dt0`, `adjoint`, `max_steps`, `throw`,
      `progress_meter`: as in `diffrax.diffeqsolve`. By default Dopri8 takes adaptive
      steps. A controller excludes `rtol`, `atol` and `max_step`. `dt0` is 1 ms; with
      `None` the controller estimates it, which fails from exact rest. Reverse mode
      works with the default `adjoint`, forward mode with `diffrax.ForwardMode()`.

    **Returns:** a `Solution`. With `throw=False` its `result` reports a failed solve,
    and states that were not reached are NaN.

    **Raises:** ValueError for malformed arguments. With `throw=True`, a failed solve
    raises the error of a force element's `check(linkage, ts)`, or else a RuntimeError.
    Warns in float32 if the tolerance cannot be met.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101))
    >>> kinetic, potential = fj.energy(arm, motion.q[-1], motion.qd[-1])
    >>> float(kinetic), float(potential)  # of 0 J at the start
    (54.889, -54.889)
    """
    check_linkage(linkage)
    single_precision("linkage", linkage)
    state0 = real_state("state0", state0, linkage)
    ts = real_numbers("ts", ts, (None,), of="times, for instance [0, 2.0]")
    increasing("ts", ts)
    keywords = solve_options(
        solver=solver,
        rtol=rtol,
        atol=atol,
        max_step=max_step,
        stepsize_controller=stepsize_controller,
        dt0=dt0,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=throw,
        progress_meter=progress_meter,
    )
    forces = elements_at_door(linkage, forces)
    prescribed(forces)  # refuses several
    if own0 is not None:
        check_own("own0", own0, forces, linkage, ())
    inputs = Inputs(linkage, state0, ts, own0, (*forces, *conditions(until)))
    try:
        solution, succeeded = solve(inputs, keywords)
        if succeeded is None:
            # The caller's `ts` itself keeps derivatives in the times.
            solution = eqx.tree_at(lambda s: s.ts, solution, jnp.asarray(ts))
            return _raising(solution, inputs) if throw else solution
    except (TypeError, StopIteration) as error:
        check_arguments(inputs.forces)
        # After other transformations JAX may find no rule at all, without a word.
        if "forward-mode" in str(error) or isinstance(error, StopIteration):
            raise TypeError(
                "forward-mode differentiation of simulate needs "
                "adjoint=diffrax.ForwardMode(); for second derivatives use "
                "jax.jacfwd(jax.jacfwd(...)) with it, not jax.hessian."
            ) from error
        raise
    except Exception as error:
        if "closed-over value" in str(error):
            raise TypeError(
                "forces: expected differentiated arrays as fields of an element or in "
                "the closure of a plain function, got one in the closure of a function "
                "that an element holds."
            ) from error
        raise
    if throw and not succeeded:
        times = jnp.asarray(ts)
        check_elements(forces, linkage, times)
        check_start(forces, linkage, state0, times)
        reached = float(solution.stats["time_reached"])
        why = cause(inputs, keywords, solution)
        raise RuntimeError(f"simulate: {solution.outcome} at t = {reached:g} s. {why}")
    return solution


def _raising(solution: Solution, inputs: Inputs) -> Solution:
    """Adds run-time errors for bad values and failures to a traced solution."""
    accepted = "expected values that its constructor accepts"
    fitting = f"{accepted} and that fit the arm"
    messages = [
        "simulate: ts: expected finite, increasing times.",
        "simulate: state0: expected finite numbers; those of a task are NaN out of "
        "reach (references.reach_margin says by how much).",
        "simulate: state0: expected positions between the hard stops, and those of a "
        "prescribed motion.",
        f"simulate: linkage: {accepted}.",
        *(
            f"simulate: forces[{k}] ({type(element).__name__}): {fitting}."
            for k, element in enumerate(inputs.forces)
        ),
    ]
    found = _faults(inputs)
    failed = solution.result != diffrax.RESULTS.successful
    try:
        raising = eqx.branched_error_if(
            solution, found.any(), jnp.argmax(found), messages
        )
        number = outcome_numbers(raising.result)
        words = [f"simulate: {word}. {why}" for word, why in OUTCOMES.items()]
        return eqx.branched_error_if(raising, failed, number, words)
    except ValueError as error:
        # Under `vmap` over no members equinox takes the maximum of none.
        if "zero-size array" not in str(error):
            raise
        return solution


@eqx.filter_jit  # one program, not one for each of its operations
def _faults(inputs: Inputs) -> Array:
    times, *others = faults(inputs)
    start = jnp.stack(inputs.state0)
    return jnp.stack([times, ~jnp.isfinite(start).all(), *others])


def check_own(
    name, own, forces: tuple[Element, ...], linkage: Linkage, rows: tuple
) -> None:
    """Raises ValueError unless `own` holds rows of the stateful elements' states."""
    states = jax.eval_shape(lambda: initial_states(linkage, forces))
    shapes = jax.tree.map(lambda leaf: (*rows, *leaf.shape), states)
    own_shapes = jax.tree.map(jnp.shape, own)
    # The shape of a number is (), as the states of no elements are.
    alike = jax.tree.structure(own) == jax.tree.structure(states)
    if not alike or own_shapes != shapes:
        expected = f"the states of the forces' elements, of shapes {shapes}"
        raise refusal(name, expected, own_shapes)
