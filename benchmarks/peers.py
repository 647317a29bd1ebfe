"""Other engines as contestants: SciPy, MuJoCo, MJX and the C kernel.

Each raises `Skipped` if it is not installed or cannot run the problem.
"""

import importlib
import math
import os
from functools import cache
from typing import Any
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .chain import make_rates
from .circle import make_control, make_reference
from .contestants import DT0, Contestant, Motion
from .measure import Skipped
from .native import Kernel
from .problems import Problem


def module(name: str) -> Any:
    """Returns an installed peer."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise Skipped(f"{name} is not installed") from None


def one_free_arm(problem: Problem) -> None:
    if problem.forces:
        raise Skipped("no controllers with limits")
    _one_arm(problem)


def _one_arm(problem: Problem) -> None:
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


_COMPILED: dict[str, tuple] = {}


def _scalar_rates(problem: Problem) -> tuple:
    """Returns the equations in plain floats and their language, compiled once."""
    if problem.name not in _COMPILED:
        compiled, language = (lambda f: f), "Python"
        try:
            compiled, language = importlib.import_module("numba").njit, "numba"
        except ImportError:
            pass
        control = make_control(problem, compiled) if problem.forces else None
        rates = make_rates(problem.linkage, math.sin, math.cos, control=control)
        _COMPILED[problem.name] = compiled(rates), language
    return _COMPILED[problem.name]


def scipy(problem: Problem, method: str) -> Contestant:
    """Returns `solve_ivp` on a right-hand side that numba compiles if installed."""
    _one_arm(problem)
    if problem.batch is not None:
        raise Skipped("no batches")
    integrate = module("scipy.integrate")
    rates, language = _scalar_rates(problem)

    def run(tolerance: float) -> Any:
        return integrate.solve_ivp(
            lambda t, y: rates(*y, t),
            (problem.ts[0], problem.ts[-1]),
            np.concatenate([problem.state0.q, problem.state0.qd]),
            method=method,
            t_eval=problem.ts,
            rtol=max(tolerance, 1e-13),
            atol=tolerance,
            first_step=DT0,
        )

    def motion(result: Any) -> Motion:
        if not result.success:
            return Motion(np.full((len(problem.ts), 3), np.nan))
        return Motion(result.y[:3].T, result.y[3:].T)

    return Contestant(f"SciPy {method}, {language}", "tolerance", run, motion)


def _with_servos(problem: Problem) -> str:
    """Returns the arm as MJCF; a controller becomes actuators."""
    text = fj.to_mjcf(problem.linkage)
    if not problem.forces:
        return text
    root, (controller,) = ElementTree.fromstring(text), problem.forces
    actuators = ElementTree.SubElement(root, "actuator")
    values = zip(
        *(np.asarray(x) for x in (controller.kp, controller.kd, controller.limit))
    )
    for joint, (kp, kd, limit) in zip(root.iter("joint"), values):
        ElementTree.SubElement(
            actuators,
            "position",
            joint=joint.attrib["name"],
            kp=repr(float(kp)),
            kv=repr(float(kd)),
            forcerange=f"{-float(limit)!r} {float(limit)!r}",
        )
    return ElementTree.tostring(root, encoding="unicode")


def mujoco(problem: Problem, integrator: str) -> Contestant:
    """Returns MuJoCo's own rollout in C; `integrator`: Euler, implicitfast or RK4.

    A controller becomes its position servos, whose set points are held over a step.
    """
    _one_arm(problem)
    mj, rollout = module("mujoco"), module("mujoco.rollout")
    model = mj.MjModel.from_xml_string(_with_servos(problem))
    kind = {"Euler": "EULER", "implicitfast": "IMPLICITFAST", "RK4": "RK4"}[integrator]
    model.opt.integrator = getattr(mj.mjtIntegrator, f"mjINT_{kind}")
    q, qd = (np.atleast_2d(a) for a in problem.state0)
    # Full physics state: time, positions, velocities.
    start = np.concatenate([np.zeros((len(q), 1)), q, qd], axis=1)
    data = [mj.MjData(model) for _ in range(min(threads(), len(q)))]
    single = problem.batch is None

    @cache
    def set_points(step: float, count: int) -> np.ndarray:
        reference, (controller,) = make_reference(problem), problem.forces
        rows = np.array([reference(k * step) for k in range(count)])
        lead = np.asarray(controller.kd / controller.kp)  # for the velocities
        return (rows[:, :3] + lead * rows[:, 3:])[None]

    def run(step: float) -> Any:
        model.opt.timestep = step
        every = _steps(problem, step)
        count = every * (len(problem.ts) - 1)
        chosen = {"control": set_points(step, count)} if problem.forces else {}
        states, _ = rollout.rollout(model, data, start, nstep=count, **chosen)
        return states[:, every - 1 :: every, 1 : start.shape[1]]

    def motion(states: np.ndarray) -> Motion:
        return Motion(*np.split(states[0] if single else states, 2, axis=-1))

    return Contestant(f"MuJoCo {integrator}", "step", run, motion)


def mjx_rk4(problem: Problem) -> Contestant:
    """Returns MuJoCo's JAX port with its RK4; the step is a traced number."""
    one_free_arm(problem)
    mj, mjx = module("mujoco"), module("mujoco.mjx")
    model = mj.MjModel.from_xml_string(fj.to_mjcf(problem.linkage))
    model.opt.integrator = mj.mjtIntegrator.mjINT_RK4
    model = mjx.put_model(model)
    blank = mjx.make_data(model)
    q, qd = (jnp.atleast_2d(jnp.asarray(a)) for a in problem.state0)
    single, saves = problem.batch is None, len(problem.ts) - 1

    @jax.jit
    def solve(q, qd, step, every):
        stepped = model.tree_replace({"opt.timestep": step})

        def member(q, qd):
            def save(data, _):
                data = jax.lax.fori_loop(
                    0, every, lambda _, d: mjx.step(stepped, d), data
                )
                return data, data.qpos

            return jax.lax.scan(save, blank.replace(qpos=q, qvel=qd), length=saves)[1]

        return member(q[0], qd[0]) if single else jax.vmap(member)(q, qd)

    return Contestant(
        "MJX RK4",
        "step",
        lambda step: solve(q, qd, jnp.asarray(step), _steps(problem, step)),
        Motion,
    )


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
