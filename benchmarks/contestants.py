"""fdof_jax and plain diffrax as contestants, and what all contestants share.

A function of a `Problem`, which may hold one motion or a batch, makes each contestant.
A contestant runs at a setting: a tolerance or a step.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj
from fdof_jax.base.configuration import wide_vectors
from fdof_jax.base.one_loop import in_one_loop
from fdof_jax.base.trigonometry import sincos

from .measure import Case
from .pendulums import absolute, accelerations, constants, relative
from .problems import Problem, controller

MAX_STEPS = 65536
DT0 = 1e-3  # estimates of the first step fail from exact rest
CHUNK = 128  # of larger batches diffrax is fastest with so many members at once


class Motion(NamedTuple):
    """The result of a run: states at the output times (..., time, n), and steps."""

    q: Any
    qd: Any = None
    steps: Any = None
    rejected: Any = None


class Contestant(NamedTuple):
    """A solver prepared for a problem: `run(setting)`, and `motion` of its result.

    `motion` is not timed.
    """

    solver: str
    kind: str
    run: Callable[[float], Any]
    motion: Callable[[Any], Motion]


def cases(contestant: Contestant, settings: tuple, exact: np.ndarray) -> list[Case]:
    """Returns a case per setting, judged by its worst position error at any time.

    `exact` may be of the first members of a batch.
    """

    def judge(result: Any) -> dict:
        motion = contestant.motion(result)
        q = np.asarray(motion.q)
        q = q[: len(exact)] if exact.ndim == 3 else q
        if q.shape[-2] < exact.shape[-2]:  # its outputs do not include the start
            q = np.concatenate([exact[..., :1, :], q], axis=-2)
        steps, rejected = (
            None if number is None else float(np.mean(number))
            for number in (motion.steps, motion.rejected)
        )
        error = float(np.abs(q - exact).max())
        return {"error": error, "steps": steps, "rejected": rejected}

    solver, kind, run, _ = contestant
    return [
        Case(solver, setting, functools.partial(run, setting), judge, kind)
        for setting in settings
    ]


def of_solution(solution: fj.Solution) -> Motion:
    counts = map(solution.stats.get, ("num_accepted_steps", "num_rejected_steps"))
    return Motion(solution.q, solution.qd, *counts)


@functools.cache  # one compilation for all problems of one form
def _simulate(axes: tuple | None) -> Callable:
    def run(linkage, state0, ts, forces, tolerance):
        def member(linkage, state0):
            return fj.simulate(
                linkage, state0, ts, forces, rtol=tolerance, atol=tolerance, throw=False
            )

        return (jax.vmap(member, axes) if axes else member)(linkage, state0)

    return _jitted(run, axes)


def _jitted(run: Callable, axes: tuple | None) -> Callable:
    """Compiles a contestant, a batch for wide vectors, as `sweep` is."""
    return jax.jit(run, compiler_options=wide_vectors() if axes else None)


def _in_chunks(member: Callable, problem: Problem) -> Callable:
    """Returns a function of linkage and state for all members."""
    axes = problem.axes
    if axes is None:
        return member
    if problem.batch <= CHUNK:
        return jax.vmap(member, axes)

    def members(linkage, state0):
        if axes[0] is None:
            one = lambda state0: member(linkage, state0)
            return jax.lax.map(one, state0, batch_size=CHUNK)
        one = lambda both: member(*both)
        return jax.lax.map(one, (linkage, state0), batch_size=CHUNK)

    return members


def _arguments(problem: Problem) -> tuple:
    return jax.tree.map(
        jnp.asarray, (problem.linkage, problem.state0, problem.ts, problem.forces)
    )


def fdof_jax(problem: Problem) -> Contestant:
    """Returns `simulate` within `jax.jit`, under `jax.vmap` for a batch."""
    run, arguments = _simulate(problem.axes), _arguments(problem)
    call = lambda setting: run(*arguments, setting)
    return Contestant("fdof_jax", "tolerance", call, of_solution)


def called(function: Callable, name: str) -> Callable[[Problem], Contestant]:
    """Returns `simulate` or `sweep` as a contestant, called as at a prompt."""

    def contestant(problem: Problem) -> Contestant:
        def run(tolerance: float):
            return function(
                problem.linkage, problem.state0, problem.ts, problem.forces,
                throw=False, rtol=tolerance, atol=tolerance,
            )  # fmt: skip

        return Contestant(name, "tolerance", run, of_solution)

    return contestant


sweep = called(fj.sweep, "fdof_jax sweep")
plain_call = called(fj.simulate, "fdof_jax, plain call")


def _by_diffrax(field: Callable, y0: Any, ts: Any, args: Any, tolerance: Any) -> Any:
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Dopri8(),
        ts[0],
        ts[-1],
        DT0,
        y0,
        args,
        # Of two times the first is the start, and saves within steps cost more.
        saveat=diffrax.SaveAt(t1=True) if len(ts) == 2 else diffrax.SaveAt(ts=ts),
        adjoint=diffrax.ForwardMode(),
        stepsize_controller=controller(tolerance),
        max_steps=MAX_STEPS,
        throw=False,
    )


def _steps(solution: Any) -> dict:
    stats = solution.stats
    return {
        "steps": stats["num_accepted_steps"],
        "rejected": stats["num_rejected_steps"],
    }


def _textbook_field(t, y, args):
    """Returns rates of the triple pendulum of point masses, as in a textbook."""
    linkage, _ = args
    mass, length, gravity = linkage.mass, linkage.length[1:], linkage.gravity
    angle, rate = jnp.cumsum(y[:3]), jnp.cumsum(y[3:])
    beyond = jnp.cumsum(mass[::-1])[::-1]
    shared = jnp.minimum(beyond[:, None], beyond[None, :])
    inertia = shared * length[:, None] * length[None, :]
    difference = angle[:, None] - angle[None, :]
    matrix = inertia * jnp.cos(difference)
    torque = -(inertia * jnp.sin(difference)) @ rate**2
    torque -= gravity * beyond * length * jnp.cos(angle)
    acceleration = jnp.linalg.solve(matrix, torque)
    return jnp.concatenate([y[3:], jnp.diff(acceleration, prepend=0)])


def _reduced_field(t, y, args):
    linkage, forces = args
    q, qd = y[:3], y[3:]
    tau = sum((element(t, q, qd, linkage) for element in forces), jnp.zeros(3))
    return jnp.concatenate([qd, fj.forward_dynamics(linkage, q, qd, tau)])


def _stacked(problem: Problem, field: Callable, name: str) -> Contestant:
    """Returns Dopri8 on a stacked state, under `jax.vmap` for a batch."""

    def run(linkage, state0, ts, forces, tolerance):
        def member(linkage, state0):
            y0 = jnp.concatenate([state0.q, state0.qd])
            solution = _by_diffrax(field, y0, ts, (linkage, forces), tolerance)
            ys = solution.ys
            return Motion(ys[:, :3], ys[:, 3:], **_steps(solution))

        return _in_chunks(member, problem)(linkage, state0)

    arguments, compiled = _arguments(problem), _jitted(run, problem.axes)
    call = lambda tolerance: compiled(*arguments, tolerance)
    return Contestant(name, "tolerance", call, lambda motion: motion)


def diffrax_textbook(problem: Problem) -> Contestant:
    """Returns Fig 5's arm as first written: arrays and `jnp.linalg.solve`."""
    return _stacked(problem, _textbook_field, "diffrax, arrays")


def diffrax_reduced(problem: Problem) -> Contestant:
    """Returns the library's own accelerations for diffrax, with its force elements."""
    return _stacked(problem, _reduced_field, "diffrax, our equations")


def diffrax_scalars(problem: Problem) -> Contestant:
    """Returns a pendulum as diffrax's author would advise: scalars, written out."""
    arm = constants(problem.linkage)
    n = len(arm.second)

    def field(t, y, args):
        angle, rate = y[:n], y[n:]
        found = accelerations(arm, angle, rate, jnp.sin, jnp.cos)
        return (*rate, *found)

    def run(y0, tolerance):
        def member(_, y0):
            solution = _by_diffrax(field, tuple(y0), ts, None, tolerance)
            assert solution.ys is not None
            return jnp.stack(solution.ys, axis=-1), _steps(solution)

        return _in_chunks(member, problem)(None, y0)

    ts, y0 = jnp.asarray(problem.ts), jnp.asarray(absolute(arm, *problem.state0))

    def motion(result: Any) -> Motion:
        states, steps = result
        return Motion(*relative(arm, states), **steps)

    compiled = _jitted(run, problem.axes)
    call = lambda tolerance: compiled(y0, tolerance)
    return Contestant("diffrax, scalars", "tolerance", call, motion)


def equations_alone(problem: Problem) -> Case:
    """Returns evaluations of heyoka's equations, of which XLA makes one loop."""
    arm, repeats = constants(problem.linkage), 1000
    n = len(arm.second)
    sin, cos = (lambda x: sincos(x)[0]), (lambda x: sincos(x)[1])

    def advance(_, y):
        found = accelerations(arm, y[:n], y[n:], sin, cos)
        return tuple(a + 1e-9 * b for a, b in zip(y, in_one_loop((*y[n:], *found))))

    repeated = lambda y: jax.lax.fori_loop(0, repeats, advance, y)
    compiled = jax.jit(repeated, compiler_options=wide_vectors())
    y0 = tuple(jnp.asarray(absolute(arm, *problem.state0).T))
    count = {"evaluations": repeats * len(y0[0])}
    return Case("XLA", None, lambda: compiled(y0), fields=count)
