"""A sweep on one core, as a contestant among those that may use several.

JAX has threads for the cores that it finds when it starts. The sweep therefore runs in
a process of its own, pinned to one core.
"""

import multiprocessing
import os
from multiprocessing.connection import Connection

from .contestants import Contestant, Motion
from .problems import Problem, fig5_batch


def _serve(pipe: Connection, core: int, batch: int) -> None:
    """Runs a sweep for each tolerance received, and sends its motion if asked."""
    os.sched_setaffinity(0, {core})
    import fdof_jax as fj

    from .contestants import sweep

    fj.configure(x64=True)
    contestant, result = sweep(fig5_batch(batch)), None
    while True:
        try:
            tolerance = pipe.recv()
        except EOFError:  # the benchmark is done
            return
        if tolerance is None:
            pipe.send(tuple(contestant.motion(result)))
        else:
            result = contestant.run(tolerance)
            pipe.send(None)


def sweep(problem: Problem) -> Contestant:
    """Returns `sweep` of Fig 5's batch on one core."""
    processes = multiprocessing.get_context("spawn")
    pipe, other = processes.Pipe()
    core = min(os.sched_getaffinity(0))
    process = processes.Process(
        target=_serve, args=(other, core, problem.batch), daemon=True
    )
    process.start()
    other.close()  # so that a dead process ends `recv`

    def ask(tolerance: float | None):
        pipe.send(tolerance)
        return pipe.recv()

    return Contestant(
        "fdof_jax sweep, one core", "tolerance", ask, lambda _: Motion(*ask(None))
    )
