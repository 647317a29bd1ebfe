"""The price of generality: one fixed-step RK4 on equations in different forms.

Existence factors as data are compared with a topology known at compile time, reduced
equations on scalars with the published form of twelve states and a masked 6x6 solve,
and JAX with C. The scheme, the steps and the batch are the same for all; no adaptive
solver takes part.
"""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj
from fdof_jax.mechanics.equations import link_constants, zeros
from fdof_jax.mechanics.rates import rates

from . import problems
from .contestants import Contestant, Motion, cases, masked_form, reduced_form
from .measure import Skipped, measure, skipped
from .peers import native
from .problems import Problem, reference

PROTOCOL = "generality"
BASELINE = "EF as arrays"
STEP = 1e-3


def _rk4(field: Callable, y, step, steps):
    """Takes classical Runge-Kutta steps over any pytree; their number is traced."""

    def along(y, k, factor):
        return jax.tree.map(lambda a, b: a + factor * b, y, k)

    def one(_, y):
        k1 = field(y)
        k2 = field(along(y, k1, step / 2))
        k3 = field(along(y, k2, step / 2))
        k4 = field(along(y, k3, step))
        mean = jax.tree.map(
            lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4
        )
        return along(y, mean, step)

    return jax.lax.fori_loop(0, steps, one, y)


def _contestant(problem: Problem, name: str, member: Callable, axes) -> Contestant:
    solve = jax.jit(jax.vmap(member, (*axes, None, None)))
    linkage, state0 = jax.tree.map(jnp.asarray, (problem.linkage, problem.state0))
    steps = round(float(problem.ts[-1]) / STEP)
    return Contestant(
        name,
        "step",
        lambda step: solve(linkage, state0, step, steps),
        lambda q: Motion(q[:, None]),
    )


def _scalars(problem: Problem, name: str, revolute: tuple | None, axes) -> Contestant:
    """Returns the library's right-hand side; `revolute`: the topology, if known."""

    def member(linkage, state0, step, steps):
        constants = link_constants(linkage, state0.q)
        if revolute is not None:
            slides = ~(revolute[1] | revolute[2])
            constants = constants._replace(revolute=revolute, slide_on_slide=slides)
        none = zeros(state0.q)

        def field(y):
            return rates(constants, *y, none)

        delta, _ = _rk4(field, (none, tuple(state0.qd)), step, steps)
        return state0.q + jnp.stack(delta)

    return _contestant(problem, name, member, axes)


def _stacked(problem: Problem, name: str, form, axes) -> Contestant:
    def member(linkage, state0, step, steps):
        def field(y):
            return form.field(0.0, y, (linkage, ()))

        y = _rk4(field, form.start(linkage, state0), step, steps)
        return form.joints(linkage, y)[0]

    return _contestant(problem, name, member, axes)


def _problem(topology: str, batch: int, steps: int) -> Problem:
    rng = np.random.default_rng(3)
    if topology == "RRR":
        linkage = fj.scenes.fig5().linkage
    else:
        linkage = problems.random_linkage(topology, rng)
    q = rng.uniform(-0.5, 0.5, (batch, 3))
    ts = np.array([0.0, steps * STEP])
    state0 = fj.State(q, np.zeros_like(q))
    return Problem(f"{topology}-rk4", linkage, state0, (), ts, topology)


def _contestants(problem: Problem) -> Iterator[Contestant | tuple[str, str]]:
    one = problem.axes
    revolute = tuple(np.bool_(joint == "R") for joint in problem.topology)
    yield _scalars(problem, BASELINE, None, one)
    yield _scalars(problem, "topology known at compile time", revolute, one)
    own_arm = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (problem.batch, *jnp.shape(leaf))),
        problem.linkage,
    )
    each = problem._replace(linkage=own_arm)
    yield _scalars(each, "EF as arrays, an arm per member", None, each.axes)
    yield _stacked(problem, "6 states stacked", reduced_form, one)
    yield _stacked(problem, "published: 12 states, 6x6", masked_form, one)
    try:
        yield native(problem, "RK4")
    except Skipped as reason:
        yield "C RK4", str(reason)


def run(quick: bool) -> Iterator[dict]:
    batch, steps = (100, 20) if quick else (1000, 100)
    for topology in ("RRR",) if quick else ("RRR", "RPR"):
        problem = _problem(topology, batch, steps)
        exact, prepared = reference(problem), []
        for contestant in _contestants(problem):
            if isinstance(contestant, Contestant):
                prepared += cases(contestant, (STEP,), exact, problem)
            else:
                yield skipped(PROTOCOL, *contestant)
        yield from measure(
            PROTOCOL,
            prepared,
            budget=1 if quick else 30,
            ratio_to=BASELINE,
            equal_error=False,
            problem=problem.name,
            batch=batch,
            member_steps=batch * steps,
        )
