"""Engines for the hard cases, each used as its documentation suggests.

MuJoCo's steps are divided by ten until the scene is solved or a run takes too long.
"""

from collections.abc import Callable
from typing import Any, NamedTuple
from xml.etree import ElementTree

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .chain import make_rates
from .hard_scenes import HardScene
from .measure import Skipped
from .peers import module
from .taylor import symbolic

MAX_STEPS = 5_000_000  # of adaptive solvers
MUJOCO_STEPS = (1e-2, 1e-3, 1e-4, 1e-5)
MUJOCO_MOST = 2_000_000  # steps of one run


class Refused(Exception):
    """Raised for a named result instead of a motion."""


class Run(NamedTuple):
    """A motion at the output times, and the number of steps."""

    q: Any
    qd: Any
    steps: int | None = None


def fdof_jax(scene: HardScene) -> Callable[[], Run]:
    forces: tuple = ()
    if scene.driven is not None:
        effort, stiffness, target, damping = scene.drive
        forces = fj.JointEffort(effort), fj.JointDamper(damping)
        if np.any(stiffness):
            held = lambda t, linkage: (jnp.asarray(target), jnp.zeros(3))
            controller = fj.PDController(stiffness, damping, np.inf, held)
            forces = (controller, fj.JointEffort(effort))
    steps: Any = diffrax.PIDController(rtol=scene.tolerance, atol=scene.tolerance)
    if scene.derivative:
        steps = None  # the default, which bounds the error of derivatives too
    keywords: dict[str, Any] = dict(
        solver=diffrax.Kvaerno5() if scene.stiff else None,
        stepsize_controller=steps,
        dt0=scene.first_step,
        max_steps=MAX_STEPS,
        throw=False,
    )
    if scene.derivative:
        keywords["adjoint"] = diffrax.ForwardMode()

    @jax.jit
    def solve(q0):
        state0 = fj.State(q0, scene.state0.qd)
        return fj.simulate(scene.linkage, state0, scene.ts, forces, **keywords)

    def run(q0) -> Run:
        motion = solve(q0)
        if motion.outcome != "successful":
            raise Refused(str(motion.outcome))
        return Run(motion.q, motion.qd, int(motion.stats["num_steps"]))

    slope = jax.jit(jax.jacfwd(lambda q0: solve(q0).q[-1]))
    return _with_start(scene, run, slope)


def plain_diffrax(scene: HardScene) -> Callable[[], Run]:
    """Runs diffeqsolve on textbook equations, independent of the library."""
    rates = make_rates(scene.linkage, jnp.sin, jnp.cos, scene.driven)
    steps = diffrax.PIDController(rtol=scene.tolerance, atol=scene.tolerance)

    @jax.jit
    def solve(q0):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: jnp.stack(rates(*y))),
            diffrax.Kvaerno5() if scene.stiff else diffrax.Dopri8(),
            scene.ts[0],
            scene.ts[-1],
            scene.first_step,
            jnp.concatenate([q0, jnp.asarray(scene.state0.qd)]),
            saveat=diffrax.SaveAt(ts=scene.ts),
            stepsize_controller=steps,
            max_steps=MAX_STEPS,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )

    def run(q0) -> Run:
        solution = solve(q0)
        if solution.result != diffrax.RESULTS.successful:
            raise Refused(diffrax.RESULTS[solution.result].split(".")[0])
        states = solution.ys
        return Run(states[:, :3], states[:, 3:], int(solution.stats["num_steps"]))

    return _with_start(scene, run, jax.jit(jax.jacfwd(lambda q0: solve(q0).ys[-1, :3])))


def _with_start(scene: HardScene, run: Callable, slope: Callable) -> Callable[[], Run]:
    q0 = jnp.asarray(scene.state0.q)
    if scene.derivative:
        return lambda: Run(jax.block_until_ready(slope(q0)), None)
    return lambda: run(q0)


def _motion_only(scene: HardScene) -> None:
    if scene.derivative:
        raise Skipped("derivatives are not asked of it")


def heyoka(scene: HardScene) -> Callable[[], Run]:
    _motion_only(scene)
    hy = module("heyoka")
    start = np.concatenate(list(map(np.asarray, scene.state0)))
    system = symbolic(hy, scene.linkage, scene.driven)
    integrator = hy.taylor_adaptive(system, start, tol=max(scene.tolerance, 1e-15))

    def run() -> Run:
        integrator.time = float(scene.ts[0])
        integrator.state[:] = start
        rows, steps = [start], 0
        times = scene.ts[1:]
        if scene.first_step is not None:
            times = np.concatenate([[scene.ts[0] + scene.first_step], times])
        for t in times:
            outcome, *_, count, _, _ = integrator.propagate_until(
                float(t), max_steps=MAX_STEPS
            )
            steps += count
            if outcome != hy.taylor_outcome.time_limit:
                raise Refused(str(outcome).split(".")[-1])
            rows.append(integrator.state.copy())
        if scene.first_step is not None:
            del rows[1]
        states = np.array(rows)
        return Run(states[:, :3], states[:, 3:], steps)

    return run


def mujoco(scene: HardScene) -> Callable[[], Run]:
    _motion_only(scene)
    mj, rollout = module("mujoco"), module("mujoco.rollout")
    xml = ElementTree.fromstring(fj.to_mjcf(scene.linkage))
    effort, stiffness, target, damping = scene.drive
    for joint, k, rest, d in zip(xml.iter("joint"), stiffness, target, damping):
        numbers = zip(("stiffness", "springref", "damping"), (k, rest, d))
        joint.attrib.update({name: repr(float(value)) for name, value in numbers})
    model = mj.MjModel.from_xml_string(ElementTree.tostring(xml, encoding="unicode"))
    model.opt.integrator = mj.mjtIntegrator.mjINT_RK4
    start = np.concatenate([[0.0], *map(np.asarray, scene.state0)])[None]
    between = float(scene.ts[1] - scene.ts[0])
    data = mj.MjData(model)

    def once(step: float) -> Run:
        every = max(1, round(between / step))
        model.opt.timestep = between / every
        states, rows = start, [start[0]]
        for _ in scene.ts[1:]:  # piece by piece: a rollout returns every step
            state = states[:, : 1 + 6]
            control = np.broadcast_to(np.asarray(effort, float), (1, every, 3))
            states, _ = rollout.rollout(
                model, data, state, np.ascontiguousarray(control),
                control_spec=mj.mjtState.mjSTATE_QFRC_APPLIED.value,
            )  # fmt: skip
            states = states[:, -1]
            rows.append(states[0])
            if any(w.number for w in data.warning):
                raise Refused("warning: bad accelerations")
        states = np.array(rows)
        return Run(states[:, 1:4], states[:, 4:7], every * (len(scene.ts) - 1))

    refusal: Exception = Refused("no step of these")
    chosen = None
    for step in MUJOCO_STEPS:
        if (scene.ts[-1] - scene.ts[0]) / step > MUJOCO_MOST:
            break
        try:
            result = once(step)
        except Refused as failure:
            refusal = failure  # possibly because the step was too long
            continue
        chosen = step
        if error_of(scene, result) <= scene.bound:
            break
    if chosen is None:
        raise refusal
    return lambda: once(chosen)


def error_of(scene: HardScene, run: Run) -> float:
    with np.errstate(all="ignore"):
        return scene.judge(np.asarray(run.q), np.asarray(run.qd))


ENGINES = {
    "fdof_jax": fdof_jax,
    "plain diffrax": plain_diffrax,
    "MuJoCo RK4": mujoco,
    "heyoka": heyoka,
}
