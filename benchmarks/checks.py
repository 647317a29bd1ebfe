"""The cost to ordinary scenes of watching for ill-conditioned equations.

The same solver takes the same steps with and without its watch over the conditioning.
"""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp

from fdof_jax.steps.unrolled_dopri8 import UnrolledDopri8

from . import problems
from .contestants import cases, fdof_jax
from .measure import measure
from .problems import reference

PROTOCOL = "checks"
WATCHED, UNWATCHED = "watched", "not watched"
TOLERANCE = 1e-9


class _Unwatched(UnrolledDopri8):
    """A solver that treats all rates as well-conditioned."""

    def _plain(self, terms):
        field = terms.term.vector_field
        healthy = lambda *arguments: (field(*arguments), (jnp.ones(()),) * 3)
        term = dataclasses.replace(terms.term, watched_field=healthy)
        return eqx.tree_at(lambda wrapped: wrapped.term, terms, term)

    def init(self, terms, t0, t1, y0, args):
        return super().init(self._plain(terms), t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        plain = self._plain(terms)
        return super().step(plain, t0, t1, y0, args, solver_state, made_jump)


def run(quick: bool) -> Iterator[dict]:
    for problem in (
        problems.fig5(),
        problems.fig5_batch(64 if quick else 1024),
        problems.mixed_batch(64 if quick else 1024),
    ):
        exact, prepared = reference(problem), []
        for name, solver in ((WATCHED, UnrolledDopri8()), (UNWATCHED, _Unwatched())):
            contestant = fdof_jax(problem, solver)._replace(solver=name)
            prepared += cases(contestant, (TOLERANCE,), exact, problem)
        batch = problem.batch or 1
        for point in measure(
            PROTOCOL,
            prepared,
            budget=2 if quick else 20,
            ratio_to=UNWATCHED,
            equal_error=False,
            problem=f"{problem.name}, batch of {batch}",
            batch=batch,
        ):
            yield {**point, "member_steps": batch * (point["steps"] or 1)}
