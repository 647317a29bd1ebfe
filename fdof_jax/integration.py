"""The vector field of a linkage with force elements, integrated by diffrax."""

import inspect
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .added_inertia import added_inertia, inertial
from .forces import Forces, ScalarElement, StatefulElement
from .linkage import Linkage, possible
from .rates import Added, rates, rates_and_conditioning
from .reduced_equations import Constants, link_constants, zeros
from .solution import Solution
from .step_control import Watched, bounded, default_controller, landing_on
from .unrolled_dopri8 import ScheduledTerm, UnrolledDopri8

# Steps over the time scale of a mode that keep its tangents to 1e-7 over 10 s: those of
# methods of order 8, and of lower ones down to 5.
_OF_TIME_SCALE = 0.7, 0.1

# With inertia ratios below this the accelerations are right to six digits (float64) or
# two at best, and adaptive steps are chosen by rounding.
_LEAST_INERTIA_RATIO = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-5}


class _Args(NamedTuple):
    linkage: Linkage
    q0: Array
    constants: Constants
    forces: Forces


def _schedule(t: Array, args: _Args) -> tuple[Any, ...]:
    """What the force elements take from time alone, or the time."""
    return tuple(
        element.schedule(t, args.linkage) if isinstance(element, ScalarElement) else t
        for element in args.forces
    )


def stateful(forces: Forces) -> list[StatefulElement]:
    """Those of the elements that have a state of their own."""
    return [element for element in forces if isinstance(element, StatefulElement)]


def _own_states(args: _Args, scalars: tuple[Array, ...]) -> list[Any]:
    """The states of the stateful elements, of the scalars that are integrated."""
    states, place = [], 0
    for element in stateful(args.forces):
        shapes = jax.eval_shape(element.initial_state, args.linkage)
        leaves, structure = jax.tree.flatten(shapes)
        arrays = []
        for leaf in leaves:
            own = scalars[place : place + leaf.size]
            arrays.append(jnp.stack(own).reshape(leaf.shape))
            place += leaf.size
        states.append(jax.tree.unflatten(structure, arrays))
    return states


def _scalars(tree: Any, dtype: Any) -> tuple[Array, ...]:
    leaves = [jnp.asarray(leaf, dtype).ravel() for leaf in jax.tree.leaves(tree)]
    return tuple(jnp.concatenate(leaves)) if leaves else ()


class _Load(NamedTuple):
    """What the force elements do: efforts, rates of their own states, inertia."""

    tau: tuple[Array, ...]
    own_rates: tuple[Array, ...]
    added: Added | None


def _load(t: Any, y: Any, args: _Args, schedule: tuple[Any, ...]) -> _Load:
    """Arrays are made only for elements that are written in them."""
    delta, qd, *own = y
    states = iter(_own_states(args, *own) if own else ())
    tau, own_rates = None, []
    arrays = lambda: (args.q0 + jnp.stack(delta), jnp.stack(qd))
    for index, (element, scheduled) in enumerate(zip(args.forces, schedule)):
        if isinstance(element, ScalarElement):
            q = tuple(a + b for a, b in zip(args.q0, delta))
            effort = element.respond(scheduled, q, qd, args.linkage)
        else:
            state = next(states) if isinstance(element, StatefulElement) else None
            effort, rate = element_effort(
                index, element, t, *arrays(), args.linkage, state
            )
            own_rates += _scalars(rate, args.q0.dtype)
        tau = effort if tau is None else tuple(a + b for a, b in zip(tau, effort))
    tau = zeros(args.q0) if tau is None else tuple(tau)
    if not inertial(args.forces):
        return _Load(tau, tuple(own_rates), None)
    added, bias = _added(args.linkage, inertial(args.forces), *arrays())
    tau = tuple(a - b for a, b in zip(tau, bias))
    return _Load(tau, tuple(own_rates), added)


_added: Any = eqx.filter_jit(added_inertia)  # traced once, not at each use by a solver


def _vector_field(t, y, args, schedule) -> tuple[Any, ...]:
    """Rates of six scalars and the elements' own; positions are displacements."""
    delta, qd, *own = y
    load = _load(t, y, args, schedule)
    moving = rates(args.constants, delta, qd, load.tau, load.added)
    return (*moving, load.own_rates) if own else moving


def _watched_field(t, y, args, schedule) -> tuple[tuple[Any, ...], Array]:
    """The same, and the health of the accelerations: see `ScheduledTerm`."""
    delta, qd, *own = y
    load = _load(t, y, args, schedule)
    (qd, qdd), loss = rates_and_conditioning(
        args.constants, delta, qd, load.tau, load.added
    )
    finite = jnp.isfinite(qdd[0] + qdd[1] + qdd[2] + sum(load.own_rates))
    health = jnp.where(loss * _LEAST_INERTIA_RATIO[loss.dtype] > 1, 0, loss)
    # A singular matrix makes accelerations that are not finite.
    health = jnp.where(finite | (health == 0), health, jnp.nan)
    return ((qd, qdd, load.own_rates) if own else (qd, qdd)), health


def _health(t, y, args) -> Array:
    _, health = _watched_field(t, y, args, _schedule(t, args))
    return health


@eqx.filter_jit  # traced once, not at each use by a solver
def element_effort(
    index: int,
    element: Any,
    t: Array,
    q: Array,
    qd: Array,
    linkage: Linkage,
    state: Any = None,
) -> tuple[Array, Any]:
    """What one force element returns, refused unless it is three real numbers.

    And the rate of its state, None for an element without one.
    """
    expected = f"forces[{index}]: expected it to return tau, an array of 3 real numbers"
    if isinstance(element, StatefulElement):
        found = element(t, q, qd, linkage, state)
        if not isinstance(found, tuple) or len(found) != 2:
            raise ValueError(f"{expected}, and the rate of its state, got {found!r}.")
        tau, rate = found
        if jax.tree.map(jnp.shape, rate) != jax.tree.map(jnp.shape, state):
            raise ValueError(
                f"forces[{index}]: expected the rate of its state to be like the "
                f"state, {state!r}, got {rate!r}."
            )
    else:
        tau, rate = element(t, q, qd, linkage), None
    try:
        tau = jnp.asarray(tau)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{expected}, got {tau!r}.") from error
    if tau.shape != (3,) or tau.dtype.kind not in "iuf":
        raise ValueError(f"{expected}, got shape {tau.shape} and dtype {tau.dtype}.")
    return tau.astype(q.dtype), rate


def _initial_own(args: _Args) -> tuple[tuple[Array, ...], ...]:
    """The elements' own states at the start, where there are any."""
    initial = [e.initial_state(args.linkage) for e in stateful(args.forces)]
    return (_scalars(initial, args.q0.dtype),) if initial else ()


def _step_for_tangents(t0: Array, args: _Args, fraction: float) -> Array:
    """A step short enough for derivatives [s], where the motion would allow more.

    A fraction of the time scale 1/omega of the fastest mode about the start: a step's
    length is chosen by the error of the motion alone, and an arm that hangs at rest has
    none. The trace of the squared linearisation bounds omega^2 free of units.
    """
    still = zeros(args.q0)
    scheduled = _schedule(t0, args)
    own = _initial_own(args)

    def accelerations(delta):
        y = (tuple(delta), still, *own)
        return jnp.stack(_vector_field(t0, y, args, scheduled)[1])

    linearised = jax.jacfwd(accelerations)(jnp.zeros_like(args.q0))
    omega2 = jnp.sqrt(jnp.abs(jnp.sum(linearised * linearised.T)))
    step = fraction / jnp.sqrt(omega2)
    return jax.lax.stop_gradient(jnp.where(step > 0, step, jnp.inf))


def _default_solver(forces: Forces, for_tangents=False) -> diffrax.AbstractSolver:
    # Thirteen copies of equations that are differentiated anew take minutes to compile.
    return diffrax.Dopri8() if inertial(forces) else UnrolledDopri8(for_tangents)


def _integrate(solver, inputs, keywords, derivatives: bool = False) -> Solution:
    """`derivatives`: whether they are wanted, to the accuracy of the default steps."""
    linkage, state0, asked, forces = inputs
    # What no door has seen is told by the result. Something harmless is integrated in
    # its place: derivatives of NaN would spoil those in what is shared with others.
    increasing = (jnp.diff(asked) > 0).all()
    harmless = 1e-3 * jnp.arange(len(asked), dtype=asked.dtype)
    ts = jnp.where(increasing, asked, harmless)
    finite = (jnp.isfinite(state0.q) & jnp.isfinite(state0.qd)).all()
    valid = possible(linkage) & increasing & finite
    for element in forces:
        if hasattr(element, "possible"):
            valid = valid & element.possible()
    q0, qd0 = (jnp.where(finite, a, 0) for a in state0)
    # Once per solve: the start may be any number of turns away.
    constants = link_constants(linkage, q0, lambda x: (jnp.sin(x), jnp.cos(x)))
    args = _Args(linkage, q0, constants, forces)
    term = ScheduledTerm(_vector_field, _watched_field, _schedule)
    controller = keywords["stepsize_controller"]
    # Stiff modes, which implicit solvers are taken for, would make the steps too short.
    own = controller is not None and isinstance(solver, diffrax.AbstractImplicitSolver)
    if controller is None:
        controller = default_controller()
    if derivatives and not own:
        fraction = _OF_TIME_SCALE[0 if (solver.order(term) or 0) >= 8 else 1]
        longest = lambda: _step_for_tangents(ts[0], args, fraction)
        controller = bounded(controller, longest)
    jumps = [f.jump_ts for f in forces if getattr(f, "jump_ts", None) is not None]
    if jumps:
        times = jnp.concatenate([jnp.asarray(j, ts.dtype) for j in jumps])
        controller = landing_on(controller, times)
    adaptive = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    if adaptive and not isinstance(solver, UnrolledDopri8):
        controller = Watched(controller, _health)  # pyright: ignore[reportCallIssue]
    solution = diffrax.diffeqsolve(
        term,
        solver,
        t0=ts[0],
        t1=ts[-1],
        y0=(zeros(q0), tuple(qd0), *_initial_own(args)),
        args=args,
        saveat=diffrax.SaveAt(
            subs=(
                diffrax.SubSaveAt(ts=ts),
                diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: t),
            )
        ),
        **keywords | {"stepsize_controller": controller},
    )
    assert solution.ys is not None  # because of saveat
    motion, (reached,) = solution.ys
    delta, qd = (jnp.stack(rows, axis=-1) for rows in motion[:2])
    own = [jax.vmap(lambda rows: _own_states(args, rows))(o) for o in motion[2:]]
    q = q0[None] + delta

    def shown(a):
        """NaN where diffrax has not come to save: it leaves infinity."""
        return jnp.where(jnp.isinf(a) | ~valid, jnp.nan, a)

    # diffrax saves the start with the first step.
    q, qd = shown(q).at[0].set(state0.q), shown(qd).at[0].set(state0.qd)
    own = tuple(jax.tree.map(shown, own[0])) if own else ()
    reached = jnp.where(valid, reached, asked[0])
    results: Any = diffrax.RESULTS
    result = results.where(valid, solution.result, results.nonfinite)
    stats = solution.stats | {"time_reached": reached}
    return Solution(asked, q, qd, stats, result, own)


@eqx.filter_custom_vjp
def _integrate_reversibly(inputs, solver, keywords) -> Solution:
    """A motion whose derivatives are taken in reverse mode, if any are.

    The default solver's unrolled stages are not for that. The replay has to come to
    the same bits: next to a saturation another rounding leads to other steps, and to a
    wrong gradient. Unrolled stages are compiled differently with derivatives and
    without; diffrax's loop over the stages is not.
    """
    # Nothing is differentiated here, and loops made for that take longer to compile.
    keywords = keywords | {"adjoint": diffrax.ForwardMode()}
    return _integrate(solver or _default_solver(inputs[-1]), inputs, keywords)


@_integrate_reversibly.def_fwd
def _integrate_reversibly_fwd(perturbed, inputs, solver, keywords):
    moving, fixed = eqx.partition(inputs, perturbed)

    def motion(moving):
        inputs = eqx.combine(moving, fixed)
        solution = _integrate(
            solver or diffrax.Dopri8(), inputs, keywords, derivatives=True
        )
        return (solution.q, solution.qd, solution.own), solution

    states, pull_back, solution = eqx.filter_vjp(motion, moving, has_aux=True)
    return solution, (pull_back, states)


@_integrate_reversibly.def_bwd
def _integrate_reversibly_bwd(
    residuals, cotangent, perturbed, inputs, solver, keywords
):
    pull_back, states = residuals
    wanted = eqx.combine(
        (cotangent.q, cotangent.qd, cotangent.own),
        jax.tree.map(jnp.zeros_like, states),
    )
    (gradient,) = pull_back(wanted)
    return gradient


def _opened(inputs):
    """The inputs, with what plain functions among the forces close over as leaves."""
    linkage, state0, ts, forces = inputs
    arguments = ts[0], *state0, linkage
    opened = tuple(
        eqx.filter_closure_convert(element, *arguments)
        if inspect.isfunction(element)
        else element
        for element in forces
    )
    return linkage, state0, ts, opened


@eqx.filter_jit
def solve(solver, inputs, keywords) -> Solution:
    adjoint = keywords["adjoint"]
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return _integrate_reversibly(_opened(inputs), solver, keywords)
    if solver is None:
        forward = isinstance(adjoint, diffrax.ForwardMode)
        solver = (
            _default_solver(inputs[-1], for_tangents=True)
            if forward
            else diffrax.Dopri8()
        )
    return _integrate(solver, inputs, keywords, derivatives=True)
