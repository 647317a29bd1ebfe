"""A sweep of 20,000 random arms of each topology: time, peak memory, and singles."""

import resource
import sys
import time
from collections.abc import Iterator

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .measure import environment

TOLERANCE = 1e-8
TS = np.linspace(0.0, 1.0, 11)
CHECKED = 10  # of each topology, against single motions


def _arms(each: int) -> tuple[fj.Linkage, fj.State]:
    """Returns arms like those of `problems.random_linkage`, all drawn at once."""
    rng = np.random.default_rng(3)
    count = 7 * each
    one = fj.scenes.fig5().linkage
    drawn = dict(
        ef=np.repeat([fj.existence_factors(t) for t in fj.TOPOLOGIES], each, axis=0),
        length=rng.uniform(0, 1.5, (count, 4)),
        com=rng.uniform(-1, 1, (count, 3, 2)),
        mass=rng.uniform(0.5, 3, (count, 3)),
        inertia=rng.uniform(0.05, 1, (count, 3)),
        locked=rng.uniform(-1, 1, (count, 3)),
        base_angle=rng.uniform(-3, 3, count),
        gravity=rng.uniform(0, 10, count),
    )
    linkage = eqx.tree_at(
        lambda x: [getattr(x, name) for name in drawn],
        one,
        [jnp.asarray(values, dtype=float) for values in drawn.values()],
    )
    q, qd = rng.uniform(-1, 1, (2, count, 3))
    return linkage, fj.State(q, qd)


def peak() -> float:
    """Returns the largest resident memory of this process so far [MB]."""
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def run(quick: bool) -> Iterator[dict]:
    each = 100 if quick else 20_000
    linkage, state0 = _arms(each)
    steps = dict(rtol=TOLERANCE, atol=TOLERANCE)
    began = time.perf_counter()
    # The shapes that a sweep needs are compiled by a small one.
    few = jax.tree.map(lambda leaf: leaf[:: max(1, each // 300)], (linkage, state0))
    fj.sweep(*few, TS, **steps)
    compiled, before = time.perf_counter() - began, peak()
    began = time.perf_counter()
    solution = fj.sweep(linkage, state0, TS, **steps)
    jax.block_until_ready(solution.q)
    wall = time.perf_counter() - began
    most = peak()
    worst = 0.0
    for member in range(0, 7 * each, each // CHECKED):
        arm, start = jax.tree.map(lambda leaf, i=member: leaf[i], (linkage, state0))
        single = fj.simulate(arm, start, TS, **steps)
        worst = max(worst, float(np.abs(single.q - solution.q[member]).max()))
    good = solution.result == diffrax.RESULTS.successful
    yield {
        "protocol": "many",
        "problem": f"7 topologies x {each}",
        "solver": "fdof_jax sweep",
        "setting": TOLERANCE,
        "batch": 7 * each,
        "status": "ok",
        "time_median": wall,
        "compile_time": compiled,
        "steps": float(np.mean(solution.stats["num_steps"])),
        "steps_max": int(np.max(solution.stats["num_steps"])),
        "successful": int(jnp.sum(good)),
        "against_singles": worst,
        "memory_before_mb": before,
        "memory_peak_mb": most,
        "saved_mb": (solution.q.nbytes + solution.qd.nbytes) / 1e6,
        **environment(),
    }
