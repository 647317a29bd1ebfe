"""Integrates a motion together with its derivatives in a few parameters.

The derivatives obey the variational equations, under the same error control as the
motion. Differentiation through the integrator would take twice as long to compile.
"""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from ..forces.element import elements
from ..linkage.linkage import without_fixed
from ..steps.controllers import adaptive, of_precision
from ..steps.dopri8 import ScheduledTerm
from ..steps.landing import end_of_run
from ..steps.step_control import StepControl
from ..steps.switch_derivatives import first_of
from ..steps.switching import Located, located
from ..steps.unchecked import diffeqsolve
from .field import args_of, initial_own, own_states, whole
from .formulation import clocks_apart, formulation, known_times
from .scene import Scene
from .solution import Solution

# Tolerance of the motion and its derivatives, whichever are larger. The steps that the
# derivatives need make the loss on Fig 7's circle right to 1e-8.
TOLERANCE = 1e-5


class Sensitivities(NamedTuple):
    """Residuals (m,) and their Jacobian (m, n), with the scene and its motion."""

    residuals: Array
    jacobian: Array
    scene: Scene
    solution: Solution


class _Varied(NamedTuple):
    """Parameters of the equations, and the sides and modes in force."""

    z: Array
    sides: Array | None = None
    modes: PyTree = None


class _LocatedRows(Located):
    """Adds what switches and known times change in the derivatives of the motion."""

    motion: ScheduledTerm  # of the motion alone
    jumps: Array | None
    slopes: Array | None  # derivatives of the jumps (jump, n)
    at_known_times: ClassVar = True

    def after_event(self, term, t, y, args, switching, sides, changed, made_jump):
        (rows,), of_motion = y, super().after_event
        event = switching, sides, changed, made_jump

        def of_row(row, z):
            args_at = args._replace(z=z)
            (row,), modes = of_motion(self.motion, t, (row,), args_at, *event)
            return row, modes

        row, along, modes = jax.linearize(of_row, rows[0], args.z, has_aux=True)
        slopes = jax.vmap(along)(rows[1:], jnp.eye(args.z.size, dtype=rows.dtype))
        return (jnp.concatenate([row[None], slopes]),), modes

    def kept(self, held, y1, y0):
        ((new,), (old,)) = y1, y0
        held = jnp.zeros(new.shape[1], bool).at[: 2 * held.size].set(jnp.tile(held, 2))
        return (jnp.where(held[None], old, new),)

    def slope_of_known(self, time: Array, z: Array) -> Array:
        """Returns the derivatives in `z` of a known time here, or 0."""
        if self.jumps is None or self.slopes is None:
            return jnp.zeros_like(z)
        distance = jnp.abs(time - self.jumps)
        index = jnp.argmin(distance)
        return jnp.where(distance[index] <= 2 * self.apart, self.slopes[index], 0)

    def lateness(self, arrival, term):
        z = arrival.args.z
        # 0, with derivatives: a known time here moves with its parameters.
        known = self.slope_of_known(arrival.t, z) @ (z - jax.lax.stop_gradient(z))
        return super().lateness(arrival, term) + known

    def shifted(self, term, t, y, args, switching, made_jump):
        if not (any(self.jumping) or self.jumps is not None):
            return y
        (rows,), time = y, switching.until
        before, after = switching.sides, args.sides

        def after_jump():
            switched = before != after
            first = first_of(switched)
            between, others = jnp.where(first, after, before), switched & ~first
            # A known time may be here too, before the switches or after them.
            ahead = switching.ahead > 0
            when, beside = jnp.where(ahead, t, time), jnp.where(ahead, before, after)
            times = jnp.stack([time, t, when, when, when])
            sides = jnp.stack([beside, beside, before, between, after])
            row = (rows[0],)
            field = lambda t, sides: self.motion.vf(t, row, args._replace(sides=sides))
            (rates,) = jax.vmap(field)(times, sides)
            late = self.slope_of_known(time, args.z)
            gain = jnp.outer(late, rates[0] - rates[1])
            # Kinks change derivatives too where a jump at a known time passes them.
            if before.size:
                places = jnp.stack([jnp.argmax(first), jnp.argmax(others)])
                before_it = args._replace(sides=before)
                values = lambda t, row, z: self.motion.switches(
                    t, (row,), before_it._replace(z=z)
                )[0][places]
                _, change = jax.linearize(values, when, rows[0], args.z)
                slopes = change(jnp.ones_like(t), rates[2], jnp.zeros_like(args.z))
                in_z = lambda row, z: change(jnp.zeros_like(t), row, z)
                arrived = rows[1:] + jnp.where(ahead, gain, 0)
                changes = jax.vmap(in_z)(arrived, jnp.eye(args.z.size))
                # In a step of no length nothing comes to its zero: it has jumped, at a
                # known time.
                some = jnp.stack([first.any(), others.any()])
                steep = some & (switching.length > 0) & (slopes != 0)
                of_zeros = -changes / jnp.where(steep, slopes, 1)[None]
                delays = jnp.where(steep[None], of_zeros, late[:, None])
                gain += delays @ (rates[2:4] - rates[3:])
            return rows.at[1:].add(gain)

        return (jax.lax.cond(made_jump, after_jump, lambda: rows),)


def _largest_rms(y: tuple[Array]) -> Array:
    """Returns the largest rms among the motion and its derivatives."""
    (state,) = y
    return jnp.sqrt(jnp.max(jnp.mean(state**2, axis=1)))


def sensitivities(
    scene_at: Callable[[Array], Scene],
    residuals: Callable[[Scene, Solution], Array],
    z: Array,
    ts: Array,
    tolerance: float = TOLERANCE,
) -> Sensitivities:
    """Computes residuals of a simulated scene and their Jacobian in `z` (n,).

    The function is pure. A motion that fails is NaN from then on.

    **Arguments:** `scene_at`: maps the parameters `z` to a scene; `residuals`: maps the
    scene and its motion at the times `ts` to an array; `tolerance`: relative and
    absolute tolerance of each step in float64.
    """

    def start_at(z):
        scene = scene_at(z)
        q0, qd0 = (
            without_fixed(scene.linkage, jnp.asarray(a, dtype=float))
            for a in scene.state0
        )
        args = args_of(scene.linkage, q0, elements("scene.forces", scene.forces))
        args = clocks_apart(args, ts)
        start = formulation(args.forces).start(args, qd0)
        return args, whole(*start, initial_own(args))

    # One array, with the motion as first row and the derivatives below, gives the
    # integrator fewer and larger operations.
    start, along = jax.linearize(
        lambda z: jnp.stack(jax.tree.leaves(start_at(z)[1])), z
    )
    args, y = start_at(z)
    structure, equations = jax.tree.structure(y), formulation(args.forces)
    directions = jnp.eye(z.size, dtype=z.dtype)

    def instant(row, varied):
        """Returns state and arguments of the motion."""
        args, _ = start_at(varied.z)
        args = args._replace(sides=varied.sides, modes=varied.modes)
        return jax.tree.unflatten(structure, tuple(row)), args

    def rates(t, row, varied):
        return jnp.stack(jax.tree.leaves(equations.term.vf(t, *instant(row, varied))))

    @jax.jit  # traced once, not at each use by the solver
    def field(t, y, varied, _):
        state, at = y[0], lambda row, z: rates(t, row, varied._replace(z=z))
        value, along = jax.linearize(at, state[0], varied.z)
        slopes = jax.vmap(along)(state[1:], directions)
        return (jnp.concatenate([value[None], slopes]),)

    def switches_of_row(t, y, varied, _):
        return equations.term.switches(t, *instant(y[0], varied))

    def switches_of(t, y, varied, schedule):
        return switches_of_row(t, (y[0][0],), varied, schedule)

    def unknown_modes(varied):
        assert equations.term.unknown_modes is not None  # of scenes that change modes
        _, args = instant(start, varied)
        return equations.term.unknown_modes(args)

    def resolve(event, y, varied):
        assert equations.term.resolve is not None
        state, modes = equations.term.resolve(event, *instant(y[0], varied))
        return (jnp.stack(jax.tree.leaves(state)),), modes

    def observed(z, t, row):
        y, args = instant(row, _Varied(z))
        return *equations.joints(args, t, y), own_states(args, y)

    tolerance = of_precision(tolerance, max(tolerance, TOLERANCE))
    controller = adaptive(tolerance, tolerance)
    controller = dataclasses.replace(controller, norm=_largest_rms)
    jumps = known_times(args)
    slopes = jax.jacfwd(lambda z: known_times(start_at(z)[0]))(z)
    y0 = (jnp.concatenate([start[None], jax.vmap(along)(directions)]),)
    changing = equations.term.resolve is not None
    events = (unknown_modes, resolve) if changing else (None, None)

    def term_of(field, switching):
        """Returns a term without schedule and health, for which nothing asks here."""
        without = lambda t, varied: (), None, None
        return ScheduledTerm(field, *without, switching, *events)  # pyright: ignore[reportCallIssue, reportArgumentType]

    term = term_of(field, switches_of)
    motion = term_of(lambda t, y, varied, _: (rates(t, y[0], varied),), switches_of_row)
    of_rows = True, motion, jumps, slopes
    locate = lambda *settings: _LocatedRows(*settings, *of_rows)  # pyright: ignore[reportCallIssue]
    # A method of few stages, because much of the work lies outside of them; as a loop
    # that `next_motion` can differentiate again.
    solver = diffrax.Tsit5(scan_kind="lax")
    solver, landing, y0 = located(locate, solver, term, ts, y0, _Varied(z), jumps)
    controller = StepControl(controller, None, False, landing, None)  # pyright: ignore[reportCallIssue]
    raw = diffeqsolve(
        term,
        solver,
        t0=ts[0],
        t1=end_of_run(ts, jumps),
        dt0=1e-3,
        y0=y0,
        args=_Varied(z),
        saveat=diffrax.SaveAt(ts=ts, fn=lambda t, y, args: y[0]),
        stepsize_controller=controller,
        adjoint=diffrax.ForwardMode(),
        max_steps=65536,
        throw=False,
    )
    assert raw.ys is not None  # because of saveat
    # diffrax leaves infinity at times that it did not reach.
    states = jnp.where(jnp.isinf(raw.ys), jnp.nan, raw.ys)

    def at_times(z, rows):
        scene = scene_at(z)
        q, qd, own = jax.vmap(observed, in_axes=(None, 0, 0))(z, ts, rows)
        solution = Solution(ts, q, qd, raw.stats, raw.result, own)
        return residuals(scene, solution), (scene, solution)

    value, change, (scene, solution) = jax.linearize(
        at_times, z, states[:, 0], has_aux=True
    )
    slopes = jnp.moveaxis(states[:, 1:], 1, 0)
    jacobian = jax.vmap(change, out_axes=1)(directions, slopes)
    return Sensitivities(value, jacobian, scene, solution)
