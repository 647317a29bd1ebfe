"""Batches that mix all topologies: random arms from random states, worst error."""

from collections.abc import Iterator

from . import batches, contestants as own
from .problems import mixed_batch, reference

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)


def run(quick: bool) -> Iterator[dict]:
    rows = [
        ("fdof_jax", own.fdof_jax, TOLERANCES),
        ("fdof_jax sweep", own.sweep, TOLERANCES),
        ("plain diffrax, reduced", own.plain_reduced, TOLERANCES),
        ("plain diffrax, masked 6x6", own.plain_masked, TOLERANCES[1::2]),
    ]
    problem = mixed_batch(64 if quick else 1024)
    budget = 5 if quick else 60
    for point in batches.measure_batch(problem, reference(problem), rows, budget):
        yield {**point, "protocol": "mixed"}
