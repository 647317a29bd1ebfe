"""Integrates the equations of motion with diffrax."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from ..checks import is_traced
from ..forces.added_inertia import inertial
from ..forces.element import Element, ForeignElement
from ..forces.part import jumps_of
from ..linkage.linkage import possible
from ..mechanics.equations import link_constants, zeros
from ..xla.callbacks import without_checks
from ..xla.configuration import small_loops_are_kernels
from .dopri8 import ScheduledTerm, constant
from .field import (
    Args,
    health_of,
    initial_own,
    own_states,
    schedule_of,
    vector_field,
    watched_field,
)
from .looped_dopri8 import LoopedDopri8
from .prescribed import (
    health_of_hybrid,
    hybrid_field,
    motion_at,
    prescribed,
    start_of,
    watched_hybrid_field,
)
from .solution import Solution
from .step_wrappers import Watched, bounded, landing_on, undifferentiated
from .steps import default_controller
from .unrolled_dopri8 import UnrolledDopri8

# Longest steps, over the time scale of a mode, that keep its tangents right to 1e-7
# over 10 s: for methods of order 8, and for lower orders down to 5.
_OF_TIME_SCALE = 0.7, 0.1


def _step_for_tangents(t0: Array, args: Args, own: tuple, fraction: float) -> Array:
    """Returns a longest step size [s] that keeps derivatives accurate.

    Adaptive steps control the error of the motion alone, which is zero for an arm that
    hangs at rest. The bound is a fraction of the time scale 1/omega of the fastest mode
    about the start. The trace of the squared linearisation bounds omega^2 in any units.
    """
    t0, args, own = constant((t0, args, own))
    still = zeros(args.q0)
    scheduled = schedule_of(t0, args)

    def accelerations(delta):
        y = (tuple(delta), still, *own)
        return jnp.stack(vector_field(t0, y, args, scheduled)[1])

    linearised = jax.jacfwd(accelerations)(jnp.zeros_like(args.q0))
    omega2 = jnp.sqrt(jnp.abs(jnp.sum(linearised * linearised.T)))
    step = fraction / jnp.sqrt(omega2)
    return jnp.where(step > 0, step, jnp.inf)


def _batch_solver(forces: tuple[Element, ...]) -> diffrax.AbstractSolver:
    """Returns the fastest solver for large batches."""
    # Thirteen unrolled copies of these equations would take minutes to compile.
    many = inertial(forces) or prescribed(forces)
    return diffrax.Dopri8() if many else UnrolledDopri8()


def _tangent_solver(forces: tuple[Element, ...]) -> diffrax.AbstractSolver:
    """Returns the fastest solver for forward-mode derivatives."""
    many = inertial(forces) or prescribed(forces)
    if many or small_loops_are_kernels():
        return LoopedDopri8()
    return UnrolledDopri8(for_tangents=True)


def _integrate(
    solver, inputs, keywords, derivatives: bool = False, padded: bool = False
) -> Solution:
    """Integrates one motion.

    `derivatives`: whether to bound the steps so that derivatives are accurate too.
    `padded`: whether the last time may be repeated.
    """
    linkage, state0, asked, own0, forces = inputs
    # Traced values were not checked before, so the result reports invalid ones. They
    # are replaced by harmless values, because derivatives of NaN would spoil those of
    # arrays that other lanes share.
    growth = jnp.diff(asked)
    increasing = ((growth >= 0) if padded else (growth > 0)).all()
    harmless = 1e-3 * jnp.arange(len(asked), dtype=asked.dtype)
    ts = jnp.where(increasing, asked, harmless)
    finite = (jnp.isfinite(state0.q) & jnp.isfinite(state0.qd)).all()
    valid = possible(linkage) & increasing & finite
    for element in forces:
        valid = valid & element.possible()
    motion = prescribed(forces)
    if motion is not None:
        valid = valid & motion.agrees(ts[0], jnp.asarray(state0.q), linkage)
    q0, qd0 = (jnp.where(finite, a, 0) for a in state0)
    # XLA's own sine and cosine, once per solve, as start angles may be large.
    constants = link_constants(linkage, q0, lambda x: (jnp.sin(x), jnp.cos(x)))
    args = Args(linkage, q0, constants, forces)
    own = initial_own(args, own0)
    for state in own:
        known = jnp.isfinite(jnp.array(state)).all()
        valid, own = valid & known, (tuple(jnp.where(known, x, 0) for x in state),)
    if motion is None:
        term = ScheduledTerm(vector_field, schedule_of, health_of, watched_field)
        start = zeros(q0), tuple(qd0)
    else:
        term = ScheduledTerm(
            hybrid_field, schedule_of, health_of_hybrid, watched_hybrid_field
        )
        start = start_of(motion, args, qd0)
    controller = keywords["stepsize_controller"]
    # Implicit solvers are chosen for stiff modes, which would bound steps too tightly.
    implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
    trusted = controller is not None and implicit
    if controller is None:
        controller = default_controller()
    if derivatives and not trusted:
        fraction = _OF_TIME_SCALE[0 if (solver.order(term) or 0) >= 8 else 1]
        longest = lambda: _step_for_tangents(ts[0], args, own, fraction)
        controller = bounded(controller, longest)
    controller = undifferentiated(controller)
    if (jumps := jumps_of(*forces)) is not None:
        controller = landing_on(controller, jumps.astype(ts.dtype))
    adaptive = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    if adaptive and not isinstance(solver, UnrolledDopri8 | LoopedDopri8):
        controller = Watched(controller, term.health)  # pyright: ignore[reportCallIssue]
    with without_checks():
        solution = diffrax.diffeqsolve(
            term,
            solver,
            t0=ts[0],
            t1=ts[-1],
            y0=(*start, *own),
            args=args,
            saveat=diffrax.SaveAt(
                subs=(
                    diffrax.SubSaveAt(ts=ts),
                    diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: t),
                )
            ),
            throw=False,
            **keywords | {"stepsize_controller": controller},
        )
    assert solution.ys is not None  # because of saveat
    states, (reached,) = solution.ys
    own_rows = [jax.vmap(lambda rows: own_states(args, rows))(o) for o in states[2:]]
    if motion is None:
        delta, qd = (jnp.stack(rows, axis=-1) for rows in states[:2])
        q = q0[None] + delta
    else:
        q, qd = jax.vmap(lambda t, y: motion_at(motion, args, t, y))(ts, states[:2])

    def shown(a):
        """Replaces the infinity that diffrax leaves at times not reached by NaN."""
        return jnp.where(jnp.isinf(a) | ~valid, jnp.nan, a)

    # diffrax saves the start only with the first step.
    q, qd = shown(q).at[0].set(state0.q), shown(qd).at[0].set(state0.qd)
    own_states_shown = tuple(jax.tree.map(shown, own_rows[0])) if own_rows else ()
    reached = jnp.where(valid, reached, asked[0])
    results: Any = diffrax.RESULTS
    # Constant steps, if too long, end in NaN and still report success.
    lost = ~(jnp.isfinite(q[-1]) & jnp.isfinite(qd[-1])).all()
    lost = lost & (solution.result == results.successful)
    result = results.where(valid & ~lost, solution.result, results.nonfinite)
    stats = solution.stats | {"time_reached": reached}
    return Solution(asked, q, qd, stats, result, own_states_shown)


@eqx.filter_custom_vjp
def _integrate_reversibly(inputs, solver, keywords) -> Solution:
    """Integrates a motion that may be differentiated by `jax.grad`.

    Unrolled stages compile differently with and without derivatives, and the replay of
    the backward pass must reproduce the same bits: they serve the plain solve alone.
    """
    # The plain solve needs no loops for reverse mode, which take longer to compile.
    keywords = keywords | {"adjoint": diffrax.ForwardMode()}
    return _integrate(solver or _batch_solver(inputs[-1]), inputs, keywords)


# Up to so many numbers, tangents cost no more than the adjoint equations (one arm or
# 256), and compile in half the time.
_FEW = 12


def _few(moving, adjoint) -> bool:
    """Returns whether tangents in all these numbers serve better than the adjoint.

    Who sets the number of checkpoints wants the adjoint.
    """
    leaves = jax.tree.leaves(moving)
    real = all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves)
    few = sum(leaf.size for leaf in leaves) <= _FEW
    return real and few and adjoint.checkpoints is None


def _with_tangents(motion, moving):
    """Returns what `motion` returns and the states' tangents in each number."""
    start, whole = ravel_pytree(moving)

    def along(direction):
        shifted = lambda numbers: motion(whole(numbers))
        return jax.jvp(shifted, (start,), (direction,), has_aux=True)

    directions = jnp.eye(len(start), dtype=start.dtype)
    return jax.vmap(along, out_axes=(None, 0, None))(directions)


@_integrate_reversibly.def_fwd
def _integrate_reversibly_fwd(perturbed, inputs, solver, keywords):
    moving, fixed = eqx.partition(inputs, perturbed)
    few = _few(moving, keywords["adjoint"])
    if few:
        solver = solver or _tangent_solver(inputs[-1])
        keywords = keywords | {"adjoint": diffrax.ForwardMode()}

    def motion(moving):
        inputs = eqx.combine(moving, fixed)
        solution = _integrate(
            solver or LoopedDopri8(), inputs, keywords, derivatives=True
        )
        return (solution.q, solution.qd, solution.own), solution

    if few:
        states, tangents, solution = _with_tangents(motion, moving)
        return solution, (tangents, states)
    states, pull_back, solution = eqx.filter_vjp(motion, moving, has_aux=True)
    return solution, (pull_back, states)


@_integrate_reversibly.def_bwd
def _integrate_reversibly_bwd(
    residuals, cotangent, perturbed, inputs, solver, keywords
):
    slopes, states = residuals
    wanted = eqx.combine(
        (cotangent.q, cotangent.qd, cotangent.own),
        jax.tree.map(jnp.zeros_like, states),
    )
    moving = eqx.filter(inputs, perturbed)
    if not _few(moving, keywords["adjoint"]):
        (gradient,) = slopes(wanted)
        return gradient
    start, whole = ravel_pytree(moving)

    def part(weight: Array, tangent: Array) -> Array:
        weight, tangent = weight.reshape(1, -1), tangent.reshape(len(start), -1)
        # States that were not reached are NaN, and constant; nor is a weight of 0 to
        # pick up a tangent that is not finite.
        unused = (weight == 0) | (tangent == 0)
        return jnp.where(unused, 0, weight * tangent).sum(axis=1)

    parts = jax.tree.leaves(jax.tree.map(part, wanted, slopes))
    return whole(jnp.sum(jnp.stack(parts), axis=0))


def _opened(inputs):
    """Returns the inputs, with the closures of plain functions as leaves."""
    linkage, state0, ts, own0, forces = inputs
    arguments = ts[0], *state0, linkage
    opened = tuple(
        element.opened(*arguments) if isinstance(element, ForeignElement) else element
        for element in forces
    )
    return linkage, state0, ts, own0, opened


def solve(solver, inputs, keywords) -> Solution:
    """Computes the motion for traced inputs: a batch, or with derivatives."""
    # Within a program, a program of its own would also be traced without derivatives.
    if not is_traced(jax.device_put(np.zeros(()))):
        return _solve_compiled(solver, inputs, keywords)
    # Within `vmap` even a tracer may hold a NumPy array, which rules of derivatives
    # refuse in JAX 0.10.
    known = jax.Array, np.ndarray, np.generic
    inputs = jax.tree.map(
        lambda x: jax.device_put(x) if isinstance(x, known) else x, inputs
    )
    return _solve(solver, inputs, keywords)


def _solve(solver, inputs, keywords) -> Solution:
    adjoint = keywords["adjoint"]
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return _integrate_reversibly(_opened(inputs), solver, keywords)
    if solver is None:
        forward = isinstance(adjoint, diffrax.ForwardMode)
        solver = _tangent_solver(inputs[-1]) if forward else LoopedDopri8()
    return _integrate(solver, inputs, keywords, derivatives=True)


_solve_compiled = eqx.filter_jit(_solve)

# All calls with at most this many output times share one program.
_FEWEST_TIMES = 512


def solve_one(solver, inputs, keywords) -> tuple[Solution, bool] | None:
    """Computes the motion of one arm from concrete inputs, and whether it succeeded.

    Output times are padded with the last one to a power of two, so that few programs
    serve all numbers of them. Returns None if a force element holds a traced value.
    """
    linkage, state0, ts, own0, forces = inputs
    times = np.asarray(ts)
    count = len(times)
    size = max(_FEWEST_TIMES, 1 << (count - 1).bit_length())
    filled = np.pad(times, (0, size - count), mode="edge")
    solution, succeeded = _solve_padded(
        solver, (linkage, state0, filled, own0, forces), keywords
    )
    if is_traced(solution):
        return None

    def cut(rows: Array) -> Array:
        # JAX slices and jnp.asarray would compile a program for each new shape.
        return jax.device_put(np.asarray(rows)[:count])

    q, qd, own = cut(solution.q), cut(solution.qd), jax.tree.map(cut, solution.own)
    whole = Solution(ts, q, qd, solution.stats, solution.result, own)
    return whole, bool(succeeded)


@eqx.filter_jit
def _solve_padded(solver, inputs, keywords) -> tuple[Solution, Array]:
    # The steps are those of the same call with forward-mode derivatives.
    derivatives = isinstance(keywords["adjoint"], diffrax.ForwardMode)
    keywords = keywords | {"adjoint": diffrax.ForwardMode()}
    solver = LoopedDopri8() if solver is None else solver
    solution = _integrate(solver, inputs, keywords, derivatives, padded=True)
    return solution, solution.result == diffrax.RESULTS.successful
