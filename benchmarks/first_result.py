"""The first result of a process, for `compile_times`: one sample.

    python -m benchmarks.first_result CASE [FOLDER]

prints seconds as JSON. `imported` and `first` are seconds of CPU from the start of the
process to the import of the library and to the first result; `again` is the wall time
of the same call with other numbers. With a folder, `configure` keeps compiled programs
there.
"""

import json
import sys
import time
from collections.abc import Callable

import numpy as np

import fdof_jax as fj

TS = np.linspace(0, 2, 201)


def _simulate(scene: fj.Scene) -> Callable:
    linkage, state0, forces, _ = scene
    return lambda scale: fj.simulate(linkage, state0, scale * TS, forces)


def fig5() -> Callable:
    return _simulate(fj.scenes.fig5())


def fig7() -> Callable:
    return _simulate(fj.scenes.fig7())


def elements() -> Callable:
    """Returns PD control along a figure eight, a spring and stops."""
    linkage = fj.Linkage(
        "RRR",
        length=[0, 1, 1, 0.3],
        com=[[0.5, 0]] * 3,
        mass=[1] * 3,
        inertia=[0.1] * 3,
    )
    start = fj.State([0.0, 1.0, 0.5], [0, 0, 0])
    task = fj.TipTask(
        fj.references.FigureEight([1.1, 0.4], [0.4, 0.2]), fj.references.Laps(2.0)
    )
    forces = (
        fj.PDController(400.0, 40.0, 1000.0, task),
        fj.SpringDamper(fj.Point(0, 0, 1), fj.Point(2, 0.5), stiffness=50, damping=1),
        fj.forces.JointStops(-3.0, 3.0),
    )
    return _simulate(fj.Scene(linkage, start, forces, 2.0))


def sweep() -> Callable:
    run = fj.sweep
    linkage, state0, forces, _ = fj.scenes.fig5()
    starts = np.asarray(state0.q) + np.linspace(-0.1, 0.1, 256)[:, None]
    members = fj.State(starts, state0.qd)
    return lambda scale: run(linkage, members, scale * TS, forces)


def _gradient(mode: str) -> Callable:
    from . import gradients

    problem = gradients.PROBLEMS[0]
    run = gradients.compiled(problem, mode)
    p = gradients.parameters(problem, 1)
    return lambda scale: run(p, scale * gradients.HORIZON, gradients.TOLERANCE)


def gradient_forward() -> Callable:
    return _gradient("forward")


def gradient_reverse() -> Callable:
    return _gradient("reverse")


def tune() -> Callable:
    run, scene = fj.tune, fj.scenes.fig7()
    return lambda scale: run(scene._replace(t1=scale * scene.t1))


CASES = {
    "Fig 5": fig5,
    "Fig 7": fig7,
    "three elements": elements,
    "sweep of 256": sweep,
    "value and gradient, forward": gradient_forward,
    "value and gradient, reverse": gradient_reverse,
    "tune Fig 7": tune,
}


def main() -> None:
    case, *folder = sys.argv[1:]
    if folder:
        fj.configure(x64=True, cache=folder[0])
    import jax

    run = CASES[case]()
    imported = time.process_time()
    jax.block_until_ready(run(1.0))
    first = time.process_time()
    began = time.perf_counter()
    jax.block_until_ready(run(0.99))
    again = time.perf_counter() - began
    print(json.dumps({"imported": imported, "first": first, "again": again}))


if __name__ == "__main__":
    main()
