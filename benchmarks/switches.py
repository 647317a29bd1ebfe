"""Derivatives of motions with switches: the errors of four ways to compute them.

What is differentiated is a weighted sum of the last positions. The error of a gradient
is relative to its norm, against extrapolated differences of motions at a tolerance of
1e-13.
"""

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import Array

import fdof_jax as fj

from .measure import record

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import switching_scenes as scenes

PROTOCOL = "switches"
DEFAULT, TIGHT = 1e-11, 1e-13  # tolerances
# Rounding weighs more in close differences, and more motions have a switch more or less
# in wide ones: the better of these counts.
CLOSE = 1e-4, 4e-7
WEIGHTS = np.array([0.6, -0.4, 0.5])
FORWARD = diffrax.ForwardMode()
# A number of checkpoints asks for the adjoint, for few parameters too. With as many as
# steps none are repeated.
REVERSE = diffrax.RecursiveCheckpointAdjoint(checkpoints=1000)
WAYS = "forward mode", "reverse mode", "plain", "events"

# Elements until an event, and the function of (q, qd) whose zero it is; None at last.
Phases = list[tuple[tuple, Callable | None]]


class Problem(NamedTuple):
    """Scenes as a function of parameters (n,) and of a member of a batch.

    - `names`: of as many equal parts of the members.
    - `together`: whether members run as one batch or one after the other.
    - `phases`: a scene's elements between its switches, where these are known.
    - `stateful`: whether elements have a state of their own, which `by_diffrax` lacks.
    """

    names: tuple[str, ...]
    scene_at: Callable[[Array, Any], fj.Scene]
    parameters: np.ndarray
    members: Any  # with a leading axis
    together: bool = False
    phases: Callable[[fj.Scene], Phases] | None = None
    stateful: bool = False


def move(p: Array, case: Any) -> fj.Scene:
    """A trapezoidal move by limited efforts; the parameter is when it begins."""
    found = scenes.scene(p[0], case)
    return found._replace(forces=found.forces[:1])


def fall(p: Array, case: Any) -> fj.Scene:
    """A fall into a cable; the parameter is the first angle."""
    found = scenes.scene(p[0], case)
    return found._replace(forces=found.forces[1:])


def contact(scene: fj.Scene) -> Phases:
    """The phases of a fall: without the spring, then with one of both sides."""
    spring, damper = scene.forces
    both = eqx.tree_at(lambda spring: spring.side, spring, jnp.array(0))
    stretch = lambda q, _: spring.length(scene.linkage, q) - spring.rest_length
    return [((damper,), stretch), ((both, damper), None)]


def fig7(p: Array, changes: Array) -> fj.Scene:
    """Fig 7: factors of kp[0], kd[1] and limit[1], a load [kg] and a change of q0."""
    arm, start, (pd,), _ = fj.scenes.fig7()
    kp, kd, limit, load, shift = changes + p
    changed = pd.kp.at[0].mul(kp), pd.kd.at[1].mul(kd), pd.limit.at[1].mul(limit)
    pd = eqx.tree_at(lambda pd: (pd.kp, pd.kd, pd.limit), pd, changed)
    arm = arm.replace(mass=arm.mass.at[2].add(load))
    return fj.Scene(arm, start._replace(q=start.q + shift), (pd,), 0.25)


def random(p: Array, member: Any) -> fj.Scene:
    """A random scene: size of the element, factor of the masses, change of q0."""
    return scenes.random_scene(*p, member)


def _stacked(*members: Any) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


CHANGES = np.array([[1, 1, 0.98, 0, 0], [1.105, 0.905, 0.98, 0.2, 0.05]])
ONE = np.array([0.1])
PROBLEMS = (
    Problem(("time of a move",), move, ONE, _stacked(scenes.LIMITED)),
    Problem(("cable",), fall, ONE, _stacked(scenes.CABLE), phases=contact),
    Problem(("Fig 7, limit[1] x 0.98", "Fig 7, all five"), fig7, np.zeros(5), CHANGES),
    Problem(
        tuple(f"random: {name}" for name in scenes.ELEMENTS), random,
        np.array([1.0, 1.0, 0.0]), scenes.random_members(), together=True,
    ),
    Problem(
        tuple(f"random: {name}" for name in scenes.MOVING), random,
        np.array([1.0, 1.0, 0.0]), scenes.random_members(scenes.MOVING), together=True,
        stateful=True,
    ),
)  # fmt: skip


class Motion(NamedTuple):
    """The end of a motion: the weighted sum, and numbers of steps and switches."""

    value: Array
    steps: Array
    switches: Array


def located(adjoint: Any, scene: fj.Scene, tolerance: Array) -> Motion:
    """Returns the end of a motion by `simulate`, whose steps end at switches."""
    arm, start, forces, t1 = scene
    found = fj.simulate(
        arm, start, jnp.array([0.0, t1]), forces, rtol=tolerance, atol=tolerance,
        adjoint=adjoint, throw=False,
    )  # fmt: skip
    stats = found.stats
    return Motion(WEIGHTS @ found.q[-1], stats["num_steps"], stats["num_switches"])


def by_diffrax(
    phases_of: Callable[[fj.Scene], Phases], scene: fj.Scene, tolerance: Array
) -> Motion:
    """Returns the end of a motion by diffrax, with an event after each phase.

    Outside of `simulate` the elements' own branches are plain choices.
    """
    arm, start, _, t1 = scene
    t, y, steps = jnp.zeros(()), jax.tree.map(jnp.asarray, tuple(start)), 0
    for forces, crossing in phases_of(scene):

        def rates(t, y, args, forces=forces):
            # None of the elements has a state of its own.
            tau = sum(f.act(t, *y, arm, f.initial_state(arm))[0] for f in forces)
            return y[1], fj.forward_dynamics(arm, *y, tau)

        event = None
        if crossing is not None:
            finder = optimistix.Newton(1e-13, 1e-13)
            event = diffrax.Event(lambda t, y, *_, g=crossing, **__: g(*y), finder)
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(rates), diffrax.Dopri8(), t, t1, 1e-3, y, event=event,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            adjoint=FORWARD, max_steps=65536, throw=False,
        )  # fmt: skip
        assert found.ts is not None and found.ys is not None  # by default the end
        t, y = found.ts[-1], jax.tree.map(lambda a: a[-1], found.ys)
        steps = steps + found.stats["num_steps"]
    return Motion(WEIGHTS @ y[0], steps, jnp.zeros(()))


def ways(problem: Problem) -> dict[str, Callable]:
    """Returns functions of (parameters, tolerance) to gradients and `Motion`s."""

    def compiled(transform, motion):
        def value(p, tolerance, member):
            found = motion(problem.scene_at(p, member), tolerance)
            return found.value, found

        def over(p, tolerance):
            one = partial(transform(value, has_aux=True), p, tolerance)
            every = jax.vmap(one) if problem.together else partial(jax.lax.map, one)
            return every(problem.members)

        return jax.jit(over)

    forward, reverse = partial(located, FORWARD), partial(located, REVERSE)
    plain = partial(by_diffrax, lambda scene: [(scene.forces, None)])
    found = [(jax.jacfwd, forward), (jax.grad, reverse)]
    if not problem.stateful:
        found.append((jax.jacfwd, plain))
    if problem.phases is not None:
        found.append((jax.jacfwd, partial(by_diffrax, problem.phases)))
    return {way: compiled(*how) for way, how in zip(WAYS, found)}


def differences(value: Callable[[np.ndarray], Any], p: np.ndarray, h: float) -> Any:
    """Returns gradients (member, n) by differences, extrapolated from two lengths."""

    def slope(h):
        steps = h * np.eye(p.size)
        ends = [(value(p + step) - value(p - step)) / (2 * h) for step in steps]
        return np.stack(ends, axis=-1)

    return (4 * slope(h) - slope(2 * h)) / 3


def measured(problem: Problem) -> Iterator[dict]:
    """Returns a record for each name, way and tolerance."""
    runs, p = ways(problem), problem.parameters
    tight = lambda p: np.asarray(runs["forward mode"](p, TIGHT)[1].value)
    exact = np.stack([differences(tight, p, h) for h in CLOSE])
    for tolerance in (DEFAULT, TIGHT) if problem.together else (DEFAULT,):
        for way, run in runs.items():
            gradient, motion = jax.tree.map(np.asarray, run(p, tolerance))
            error = np.linalg.norm(gradient - exact, axis=-1).min(axis=0)
            errors = error / np.linalg.norm(exact[0], axis=-1)
            parts = np.split(np.arange(len(errors)), len(problem.names))
            for name, rows in zip(problem.names, parts):
                yield record(
                    protocol=PROTOCOL, problem=name, solver=way, kind="tolerance",
                    setting=tolerance, batch=len(rows), parameters=p.size,
                    error=np.max(errors[rows]), errors=errors[rows],
                    steps=motion.steps[rows].mean(),
                    switches=motion.switches[rows].mean(),
                )  # fmt: skip


def run(quick: bool) -> Iterator[dict]:
    for problem in PROBLEMS[1:2] if quick else PROBLEMS:
        yield from measured(problem)
