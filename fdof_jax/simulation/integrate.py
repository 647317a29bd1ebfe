"""Integrates the equations of motion with diffrax: free, prescribed, differentiated."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ..forces.joints import EffortHistory
from ..linkage.linkage import possible, without_fixed
from ..steps.derivative_control import OfLinearised, OfTangents
from ..steps.dopri8 import ScheduledDopri8, constant
from ..steps.landing import end_of_run
from ..steps.looped_dopri8 import LoopedDopri8
from ..steps.switching import Located, LocatedImplicit, located, switching_facts
from ..steps.tolerances import accounted, step_control
from ..steps.unchecked import diffeqsolve
from .field import args_of, initial_own, own_states, whole
from .known_times import clocks_apart, known_times
from .packing import in_arrays
from .prescribed import agrees, motion_at, start_of, term_of
from .solution import Solution


def integrate(
    inputs,
    keywords,
    derivatives: bool = False,
    padded: bool = False,
    tangents: bool = False,
) -> Solution:
    """Integrates one motion, by default with `LoopedDopri8`.

    `derivatives`: whether steps are as short as accurate derivatives need.
    `tangents`: whether these are the tangents of this call, along the axis `TANGENTS`.
    `padded`: for a plain call, which has checked its inputs; the last time may be
    repeated.
    """
    linkage, state0, asked, own0, forces = inputs
    solver = _differentiable(keywords["solver"] or LoopedDopri8(), keywords["adjoint"])
    valid, ts, (q0, qd0) = _valid(inputs, padded)
    args = args_of(linkage, q0, forces)
    if derivatives:
        args = clocks_apart(args, ts)
    own = initial_own(args, own0)
    known = jnp.isfinite(jnp.array(own)).all()
    valid, own = valid & known, tuple(jnp.where(known, x, 0) for x in own)
    term = term_of(forces)
    controller = step_control(keywords["stepsize_controller"])
    unpacked, y0 = args, whole(*start_of(args, qd0), own)
    at_start = motion_at(args, ts[0], y0)  # after a blow there, like all that follows
    if padded and not derivatives:
        term, y0, args = in_arrays(term, y0, args)
    length = len(y0)
    implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
    wrapper: Any = LocatedImplicit if implicit else Located
    locate = lambda *known: wrapper(*known, derivatives)
    adaptive = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    # Fixed steps may pass over the kinks of a history, but over no jump.
    left_out = () if adaptive else (EffortHistory,)
    jumps = known_times(args, *left_out)
    start = term, ts, y0, args, jumps
    located_solver, controller, y0 = located(locate, solver, controller, *start)
    # With tolerances of one's own, an implicit solver is for modes too fast to resolve,
    # which a probe would resolve.
    trusted = implicit and keywords["stepsize_controller"] is not None
    if adaptive:
        if tangents:
            controller = OfTangents(controller)  # pyright: ignore[reportCallIssue]
        elif derivatives and not trusted:
            known = isinstance(solver, ScheduledDopri8 | diffrax.AbstractRungeKutta)
            other = diffrax.Heun.tableau
            tableau = solver.tableau if known else other  # pyright: ignore[reportAttributeAccessIssue]
            controller = OfLinearised(controller, term, tableau)  # pyright: ignore[reportCallIssue]
        controller = accounted(controller, solver, term)
    # diffrax computes a few constants while it is traced.
    with jax.transfer_guard("allow"):
        found = diffeqsolve(
            term,
            t0=ts[0],
            t1=end_of_run(ts, jumps),
            y0=y0,
            args=args,
            saveat=diffrax.SaveAt(
                subs=(
                    diffrax.SubSaveAt(ts=ts, fn=lambda t, y, args: y[:length]),
                    diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: (t, *y[length:])),
                ),
                controller_state=adaptive,
            ),
            throw=False,
            **keywords | {"solver": located_solver, "stepsize_controller": controller},
        )
    assert found.ys is not None  # because of saveat
    states, (reached, *known) = found.ys
    at = lambda t, y: (*motion_at(unpacked, t, y), own_states(args, y))
    q, qd, own = jax.vmap(at)(ts, states)

    def shown(a):
        """Replaces the infinity that diffrax leaves at times not reached by NaN."""
        return jnp.where(jnp.isinf(a) | ~valid, jnp.nan, a)

    # diffrax saves the start only with the first step.
    given = (without_fixed(linkage, value) for value in state0)
    first = (jnp.where(valid, a, b) for a, b in zip(at_start, given))
    q, qd = (shown(rows).at[0].set(row) for rows, row in zip((q, qd), first))
    # Constant steps go on when the state is no longer finite.
    reached = jnp.minimum(reached[0], ts[-1])
    lost = (ts <= reached) & ~jnp.isfinite(q + qd).all(axis=1)
    reached = jnp.where(lost.any(), ts[jnp.argmax(lost) - 1], reached)
    stats = found.stats | {"time_reached": jnp.where(valid, reached, asked[0])}
    if adaptive:
        assert found.controller_state is not None  # because of saveat
        _, loss = found.controller_state
        stats["accuracy"] = jnp.finfo(q.dtype).eps * loss
    stats |= switching_facts(*known)
    result = _judged(valid, found.result, q, qd)
    return Solution(asked, q, qd, stats, result, jax.tree.map(shown, own))


def _differentiable(solver: Any, adjoint: diffrax.AbstractAdjoint) -> Any:
    """Returns the solver with loops that the adjoint can differentiate.

    diffrax does this itself, except for a solver inside a wrapper.
    """
    kinds = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}
    kind = kinds.get(type(adjoint))
    if kind is None or not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


def _valid(inputs, padded: bool) -> tuple[Array, Array, tuple[Array, Array]]:
    """Returns whether the inputs are valid, and their times and start.

    Traced values were not checked before, so the result reports invalid ones. They are
    replaced by harmless values, because derivatives of NaN would spoil those of arrays
    that other lanes share.
    """
    linkage, state0, asked, _, forces = inputs
    if padded:  # a plain call has checked them
        q0, qd0 = (without_fixed(linkage, a) for a in state0)
        return jnp.array(True), asked, (q0, qd0)
    growth = jnp.diff(asked)
    increasing = ((growth > 0) & (growth < jnp.inf)).all()
    harmless = 1e-3 * jnp.arange(len(asked), dtype=asked.dtype)
    ts = jnp.where(increasing, asked, harmless)
    finite = (jnp.isfinite(state0.q) & jnp.isfinite(state0.qd)).all()
    valid = possible(linkage) & increasing & finite
    for element in forces:
        valid = valid & element.possible()
        valid = valid & constant(element).fits(*constant((linkage, ts)))
    valid = valid & agrees(forces, ts[0], jnp.asarray(state0.q), linkage)
    q0, qd0 = (without_fixed(linkage, jnp.where(finite, a, 0)) for a in state0)
    return valid, ts, (q0, qd0)


def _judged(valid: Array, result: Any, q: Array, qd: Array) -> Any:
    """Returns the result of a solve: not finite for invalid inputs and for NaN."""
    results: Any = diffrax.RESULTS
    # Constant steps, if too long, end in NaN and still report success.
    lost = ~(jnp.isfinite(q[-1]) & jnp.isfinite(qd[-1])).all()
    lost = lost & (result == results.successful)
    return results.where(valid & ~lost, result, results.nonfinite)
