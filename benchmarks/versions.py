"""Times Fig 7 with this version and with that of another checkout, in turn.

`python benchmarks/versions.py CHECKOUT` prints the processor time of each of them and
the median of their ratio, taken round by round: of a plain motion of 4 s, of its
derivatives in six gains by `jax.jacfwd`, by `jax.grad` and by the adjoint equations,
and of a sweep of 256 starts. `--rounds` is the number of rounds.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
REPEATS = 7  # per round


def contestants() -> dict[str, Callable[[], object]]:
    """Returns what is timed, compiled; it is called in a process of one version."""
    import diffrax
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np

    import fdof_jax as fj

    fj.configure(x64=True)
    linkage, start, forces, *_ = fj.scenes.fig7()
    (pd,) = forces
    ts = np.linspace(0, 4, 5)
    wanted = jax.vmap(pd.reference.tip)(ts)

    def loss(gains, **options):
        forces = (eqx.tree_at(lambda pd: (pd.kp, pd.kd), pd, tuple(gains)),)
        motion = fj.simulate(linkage, start, ts, forces, **options)
        tips = jax.vmap(lambda q: fj.tip_position(linkage, q))(motion.q)
        return jnp.sum((tips - wanted) ** 2), motion.stats["num_steps"]

    def forward(gains):
        return loss(gains, adjoint=diffrax.ForwardMode())

    def checkpointed(gains):
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=1024)
        return loss(gains, adjoint=adjoint)

    gains = jnp.stack([pd.kp, pd.kd])
    compiled = {
        name: jax.jit(function).lower(gains).compile()
        for name, function in {
            "plain": loss,
            "jacfwd": jax.jacfwd(forward, has_aux=True),
            "grad": jax.grad(loss, has_aux=True),
            "adjoint": jax.grad(checkpointed, has_aux=True),
        }.items()
    }
    away = np.random.default_rng(0).uniform(-0.1, 0.1, (256, 3)) * [1, 1, 0]
    starts = fj.State(np.asarray(start[0]) + away, np.zeros((256, 3)))

    def sweep():
        motions = fj.sweep(linkage, starts, ts, forces)
        return motions.q, motions.stats["num_steps"].max()

    once = {name: lambda f=f: f(gains) for name, f in compiled.items()}
    return once | {"sweep of 256": sweep}


def work() -> None:
    """Times all contestants once for each line read, and prints times and steps."""
    import jax

    def timed(run):
        began = time.process_time()
        jax.block_until_ready(run())
        return time.process_time() - began

    runs = contestants()
    steps = {name: int(jax.block_until_ready(run())[1]) for name, run in runs.items()}
    print(flush=True)
    for _ in sys.stdin:
        for name, run in runs.items():
            repeats = 1 if name.startswith("sweep") else REPEATS
            best = statistics.median(timed(run) for _ in range(repeats))
            print(name, 1e3 * best, steps[name], sep="\t")
        print(flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", type=Path, nargs="?", help="of another version")
    parser.add_argument("--rounds", type=int, default=11)
    options = parser.parse_args()
    if options.checkout is None:
        return work()
    core = str(min(os.sched_getaffinity(0)))
    processes = [
        subprocess.Popen(
            ["taskset", "-c", core, sys.executable, "-P", __file__],
            env=os.environ | {"PYTHONPATH": str(path)},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )
        for path in (options.checkout.resolve(), HERE)
    ]  # fmt: skip

    def answer(process):
        rows = iter(process.stdout.readline, "\n")
        return {name: row for name, *row in (row.split("\t") for row in rows)}

    for process in processes:
        answer(process)
    rounds = []
    for _ in range(options.rounds):
        both = []
        for process in processes:
            print(file=process.stdin, flush=True)
            both.append(answer(process))
        rounds.append(both)
    print("", "other [ms]", "this [ms]", "ratio", "steps", sep="\t")
    for name in rounds[0][0]:
        times = [[float(one[name][0]) for one in both] for both in rounds]
        other, this = (statistics.median(column) for column in zip(*times))
        ratio = statistics.median(b / a for a, b in times)
        steps = ", ".join(one[name][1].strip() for one in rounds[0])
        print(name, f"{other:.4g}", f"{this:.4g}", f"{ratio:.3f}", steps, sep="\t")


if __name__ == "__main__":
    main()
