"""MuJoCo and the C kernel as contestants.

Each raises `Skipped` if it is not installed or cannot run the problem.
"""

import importlib
import math
import os
from typing import Any

import numpy as np

import fdof_jax as fj

from .contestants import Contestant, Motion
from .measure import Skipped
from .native import Kernel
from .problems import Problem

_WRONG = "4.0.0"  # of MuJoCo: a factorisation that 4.0.1 mended


def module(name: str) -> Any:
    """Returns an installed peer."""
    try:
        found = importlib.import_module(name)
    except ImportError:
        raise Skipped(f"{name} is not installed") from None
    if name == "mujoco" and found.__version__ == _WRONG:
        raise Skipped(f"MuJoCo {_WRONG} factorises wrongly; install another")
    return found


def one_free_arm(problem: Problem) -> None:
    if problem.forces:
        raise Skipped("no controllers with limits")
    if problem.batch and problem.axes[0] == 0:
        raise Skipped("one arm only, not a batch of different ones")


def threads() -> int:
    return len(os.sched_getaffinity(0))


def _steps(problem: Problem, step: float) -> int:
    """Returns the steps between two output times, which must be a whole number."""
    between = float(problem.ts[1] - problem.ts[0])
    count = round(between / step)
    if not math.isclose(count * step, between, rel_tol=1e-9):
        raise ValueError(f"{step} s does not divide {between} s")
    return count


def mujoco(problem: Problem) -> Contestant:
    """Returns RK4 by MuJoCo's own rollout in C, with a thread for each core."""
    one_free_arm(problem)
    mj, rollout = module("mujoco"), module("mujoco.rollout")
    model = mj.MjModel.from_xml_string(fj.to_mjcf(problem.linkage))
    model.opt.integrator = mj.mjtIntegrator.mjINT_RK4
    q, qd = (np.atleast_2d(a) for a in problem.state0)
    # Full physics state: time, positions, velocities.
    start = np.concatenate([np.zeros((len(q), 1)), q, qd], axis=1)
    data = [mj.MjData(model) for _ in range(min(threads(), len(q)))]
    single = problem.batch is None

    def run(step: float) -> Any:
        model.opt.timestep = step
        every = _steps(problem, step)
        count = every * (len(problem.ts) - 1)
        states, _ = rollout.rollout(model, data, start, nstep=count)
        return states[:, every - 1 :: every, 1 : start.shape[1]]

    def motion(states: np.ndarray) -> Motion:
        return Motion(*np.split(states[0] if single else states, 2, axis=-1))

    return Contestant("MuJoCo RK4", "step", run, motion)


def native(problem: Problem, method: str) -> Contestant:
    """Returns the C kernel: "RK4" or "order 8"."""
    one_free_arm(problem)
    kernel = Kernel(
        method,
        problem.linkage,
        np.asarray(problem.state0.q),
        np.asarray(problem.state0.qd),
        threads=threads(),
    )
    saves = len(problem.ts) - 1

    def motion(saved: np.ndarray) -> Motion:
        q, qd = kernel.joints(saved)
        return Motion(q[0], qd[0]) if problem.batch is None else Motion(q, qd)

    return Contestant(
        f"C {method}",
        "step",
        lambda step: kernel(step, _steps(problem, step), saves),
        motion,
    )
