"""fdof_jax and plain diffrax as contestants, and what all contestants share.

A function of a `Problem`, which may hold one motion or a batch, makes each contestant.
A contestant runs at a setting: a tolerance or a step.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .measure import Case
from .problems import Problem, controller

MAX_STEPS = 65536
DT0 = 1e-3  # estimates of the first step fail from exact rest


class Motion(NamedTuple):
    """The result of a run: states at the output times (..., time, 3), and steps."""

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


@jax.jit
def energy(linkage: fj.Linkage, q: jax.Array, qd: jax.Array) -> jax.Array:
    """Returns the total energy at each of several states of one arm [J]."""
    kinetic, potential = jax.vmap(fj.energy, (None, 0, 0))(linkage, q, qd)
    return kinetic + potential


def _energy_defect(problem: Problem, motion: Motion) -> float | None:
    """Returns the largest change of energy [J], where only gravity does work."""
    if problem.forces or problem.batch is not None or motion.qd is None:
        return None
    start = fj.energy(problem.linkage, *problem.state0)
    values = energy(problem.linkage, jnp.asarray(motion.q), jnp.asarray(motion.qd))
    return float(jnp.max(jnp.abs(values - sum(start))))


def cases(
    contestant: Contestant,
    settings: tuple,
    exact: np.ndarray,
    problem: Problem,
    until: int | None = None,
) -> list[Case]:
    """Returns a case per setting, judged by its worst position error at any time.

    `until` restricts the error to the first output times; `error_end` covers them
    all.
    """

    def judge(result: Any) -> dict:
        motion = contestant.motion(result)
        q = np.asarray(motion.q)
        if q.shape[-2] < exact.shape[-2]:  # its outputs do not include the start
            q = np.concatenate([exact[..., :1, :], q], axis=-2)
        errors = np.abs(q - exact)
        return {
            "error": float(errors[..., :until, :].max()),
            "error_end": float(errors.max()),
            "energy_defect": _energy_defect(problem, motion),
            "steps": None if motion.steps is None else float(np.mean(motion.steps)),
            "rejected": (
                None if motion.rejected is None else float(np.mean(motion.rejected))
            ),
        }

    return [
        Case(
            contestant.solver,
            setting,
            lambda setting=setting: contestant.run(setting),
            judge,
            contestant.kind,
        )
        for setting in settings
    ]


def _solution(solution: Any) -> Motion:
    stats = solution.stats
    return Motion(
        solution.q,
        solution.qd,
        stats.get("num_accepted_steps"),
        stats.get("num_rejected_steps"),
    )


@cache  # one compilation for all problems of one form
def _simulate(
    solver: diffrax.AbstractSolver | None, axes: tuple | None, fixed: bool, long: bool
) -> Callable:
    chosen: dict[str, Any] = {} if solver is None else {"solver": solver}
    if long:
        # No limit of steps, and no checkpoints, as no gradient is taken.
        chosen.update(max_steps=None, adjoint=diffrax.ForwardMode())

    def run(linkage, state0, ts, forces, setting):
        steps: dict[str, Any] = {"rtol": setting, "atol": setting}
        if fixed:
            steps = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": setting}

        def member(linkage, state0):
            return fj.simulate(
                linkage, state0, ts, forces, throw=False, **steps, **chosen
            )

        return _over(member, axes)(linkage, state0)

    return jax.jit(run)


def _over(member: Callable, axes: tuple | None) -> Callable:
    return member if axes is None else jax.vmap(member, axes)


def _arguments(problem: Problem) -> tuple:
    return jax.tree.map(
        jnp.asarray, (problem.linkage, problem.state0, problem.ts, problem.forces)
    )


def fdof_jax(
    problem: Problem,
    solver: diffrax.AbstractSolver | None = None,
    fixed: bool = False,
    long: bool = False,
) -> Contestant:
    """Returns `simulate` as a contestant, under `jax.vmap` for a batch.

    `fixed`: the setting is a fixed step; `long`: without a limit of steps.
    """
    run, arguments = _simulate(solver, problem.axes, fixed, long), _arguments(problem)
    name = "fdof_jax" + ("" if solver is None else f" {type(solver).__name__}")
    return Contestant(
        name + (", fixed steps" if fixed else ""),
        "step" if fixed else "tolerance",
        lambda setting: run(*arguments, setting),
        _solution,
    )


def sweep(problem: Problem) -> Contestant:
    """Returns `sweep` of a batch as a contestant."""

    def run(tolerance: float):
        return fj.sweep(
            problem.linkage,
            problem.state0,
            problem.ts,
            problem.forces,
            throw=False,
            rtol=tolerance,
            atol=tolerance,
        )

    return Contestant("fdof_jax sweep", "tolerance", run, _solution)


class Form(NamedTuple):
    """One way to write the equations: `field(t, y, (linkage, forces))`."""

    name: str
    field: Callable
    start: Callable  # (linkage, state0) -> y
    joints: Callable  # (linkage, y) -> q, qd


@cache
def _plain_solve(form: Form, axes: tuple | None) -> Callable:
    def run(linkage, state0, ts, forces, tolerance):
        def member(linkage, state0):
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(form.field),
                diffrax.Dopri8(),
                ts[0],
                ts[-1],
                DT0,
                form.start(linkage, state0),
                (linkage, forces),
                saveat=diffrax.SaveAt(ts=ts),
                stepsize_controller=controller(tolerance),
                max_steps=MAX_STEPS,
                throw=False,
            )
            return Motion(
                *jax.vmap(form.joints, (None, 0))(linkage, solution.ys),
                steps=solution.stats["num_accepted_steps"],
                rejected=solution.stats["num_rejected_steps"],
            )

        return _over(member, axes)(linkage, state0)

    return jax.jit(run)


def _plain(problem: Problem, form: Form) -> Contestant:
    """Returns Dopri8 on a stacked state, under plain `jax.vmap` for a batch."""
    run, arguments = _plain_solve(form, problem.axes), _arguments(problem)
    return Contestant(
        form.name,
        "tolerance",
        lambda tolerance: run(*arguments, tolerance),
        lambda motion: motion,
    )


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


def _masked_field(t, y, args):
    linkage, _ = args
    x, xd = y[:6], y[6:]
    return jnp.concatenate(
        [xd, fj.paper.masked_accelerations(linkage, x, xd, jnp.zeros(6))]
    )


def _masked_joints(linkage, y):
    revolute = linkage.ef[1::2] > 0.5
    q = jnp.where(revolute, jnp.diff(y[1:6:2], prepend=linkage.base_angle), y[0:6:2])
    return q, jnp.where(revolute, jnp.diff(y[7::2], prepend=0), y[6::2])


def _reduced_field(t, y, args):
    linkage, forces = args
    q, qd = y[:3], y[3:]
    tau = sum((element(t, q, qd, linkage) for element in forces), jnp.zeros(3))
    return jnp.concatenate([qd, fj.forward_dynamics(linkage, q, qd, tau)])


def _stacked(linkage, state0):
    return jnp.concatenate([state0.q, state0.qd])


def _halves(linkage, y):
    return y[:3], y[3:]


textbook_form = Form("plain diffrax", _textbook_field, _stacked, _halves)
masked_form = Form(
    "plain diffrax, masked 6x6",
    _masked_field,
    lambda linkage, state0: jnp.concatenate(fj.paper.to_chain(linkage, *state0)),
    _masked_joints,
)
reduced_form = Form("plain diffrax, reduced", _reduced_field, _stacked, _halves)


def plain_textbook(problem: Problem) -> Contestant:
    """Returns textbook equations of Fig 5's arm, without any part of the library."""
    return _plain(problem, textbook_form)


def plain_masked(problem: Problem) -> Contestant:
    """Returns the published form without forces: 12 states, masked equations."""
    return _plain(problem, masked_form)


def plain_reduced(problem: Problem) -> Contestant:
    """Returns the library's own accelerations, stacked, with its force elements."""
    return _plain(problem, reduced_form)
