"""Other engines as contestants: SciPy, MuJoCo, MJX, heyoka and the C kernel.

Each raises `Skipped` if it is not installed or cannot run the problem.
"""

import importlib
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .chain import Drive, make_rates
from .circle import make_control, make_reference
from .contestants import DT0, MAX_STEPS, Contestant, Motion
from .measure import Skipped
from .native import Kernel
from .problems import Problem


def module(name: str) -> Any:
    """Returns an installed peer."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise Skipped(f"{name} is not installed") from None


def _one_free_arm(problem: Problem) -> None:
    if problem.forces:
        raise Skipped("no controllers with limits")
    _one_arm(problem)


def _one_arm(problem: Problem) -> None:
    if problem.batch and problem.axes[0] == 0:
        raise Skipped("one arm only, not a batch of different ones")


def _threads() -> int:
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
    data = [mj.MjData(model) for _ in range(min(_threads(), len(q)))]
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
    _one_free_arm(problem)
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


def symbolic(hy: Any, linkage: fj.Linkage, drive: Drive | None = None) -> list:
    """Returns the equations in heyoka's form."""
    variables = hy.make_vars("q1", "q2", "q3", "u1", "u2", "u3")

    def of(symbolic: Any, number: Any) -> Any:
        # Angles that no joint turns are plain numbers.
        return lambda x: symbolic(x) if isinstance(x, hy.expression) else number(x)

    rates = make_rates(linkage, of(hy.sin, math.sin), of(hy.cos, math.cos), drive)
    return list(zip(variables, rates(*variables)))


def extended(problem: Problem) -> np.ndarray:
    """Returns positions at the output times by heyoka in 80-bit numbers."""
    _one_free_arm(problem)
    hy = module("heyoka")
    wide = np.longdouble
    if np.finfo(wide).nmant < 63:
        raise Skipped("no 80-bit numbers here")
    start = np.concatenate([problem.state0.q, problem.state0.qd]).astype(wide)
    integrator = hy.taylor_adaptive(
        symbolic(hy, problem.linkage), start, fp_type=wide, tol=wide(1e-19)
    )
    ts = problem.ts.astype(wide)
    integrator.propagate_until(ts[0] + wide(DT0))
    grid = np.concatenate([[integrator.time], ts[1:]])
    states = integrator.propagate_grid(grid)[-1]
    states[0] = start
    return states[:, :3].astype(float)


def heyoka(
    problem: Problem, equations: Callable = symbolic, compact: bool = False
) -> Contestant:
    """Returns an adaptive Taylor series compiled by LLVM; batches in vectors.

    `compact`: compiled sooner, and slower.
    """
    _one_free_arm(problem)
    hy = module("heyoka")
    system = equations(hy, problem.linkage)
    q, qd = (np.atleast_2d(a) for a in problem.state0)
    start = np.concatenate([q, qd], axis=1).T
    begin, first, ts = problem.ts[0], problem.ts[0] + DT0, problem.ts[1:]
    single = problem.batch is None
    lanes = 1 if single else min(8, start.shape[1])
    if start.shape[1] % lanes:
        raise Skipped(f"batches that {lanes} does not divide")
    threads = _threads()

    @cache
    def prepared(tolerance: float) -> list:
        if single:
            begun = start[:, 0].copy()
            return [
                hy.taylor_adaptive(system, begun, tol=tolerance, compact_mode=compact)
            ]
        block = start[:, :lanes].copy()
        one = hy.taylor_adaptive_batch(
            system, block, tol=tolerance, compact_mode=compact
        )
        return [one, *(one.__deepcopy__({}) for _ in range(threads - 1))]

    def run_single(tolerance: float) -> np.ndarray:
        (integrator,) = prepared(tolerance)
        integrator.time = begin
        integrator.state[:] = start[:, 0]
        # From exact rest the estimate of the first step fails.
        integrator.propagate_until(first)
        grid = np.concatenate([[first], ts])
        return integrator.propagate_grid(grid)[-1][1:]

    def blocks(integrator: Any, numbers: range, ends: np.ndarray) -> None:
        for number in numbers:
            members = slice(number * lanes, (number + 1) * lanes)
            integrator.set_time(begin)
            integrator.state[:] = start[:, members]
            integrator.propagate_until(ts[-1], max_steps=MAX_STEPS)
            ends[members, 0] = integrator.state.T

    def run_batch(tolerance: float) -> np.ndarray:
        ends = np.empty((start.shape[1], 1, len(start)))
        integrators = prepared(tolerance)
        number = start.shape[1] // lanes
        if threads == 1:
            blocks(integrators[0], range(number), ends)
        else:
            with ThreadPoolExecutor(threads) as pool:
                shares = [range(i, number, threads) for i in range(threads)]
                list(pool.map(blocks, integrators, shares, [ends] * threads))
        return ends

    return Contestant(
        "heyoka",
        "tolerance",
        run_single if single else run_batch,
        lambda states: Motion(*np.split(states, 2, axis=-1)),
    )


def native(problem: Problem, method: str) -> Contestant:
    """Returns the C kernel: "RK4" or "order 8"."""
    _one_free_arm(problem)
    kernel = Kernel(
        method,
        problem.linkage,
        np.asarray(problem.state0.q),
        np.asarray(problem.state0.qd),
        threads=_threads(),
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
