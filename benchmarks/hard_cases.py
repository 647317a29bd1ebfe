"""The hard cases on four engines: solved, refused as asked, or failed, and how.

Each engine is used as its documentation suggests, at the tolerance that a scene names.
MuJoCo's steps are divided by ten until the scene is solved or a run takes too long.
"""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .chain import make_rates
from .hard_scenes import HardScene, hard, motions
from .measure import OUTCOMES, Skipped, record
from .peers import module, symbolic

PROTOCOL = "hard_cases"
MAX_STEPS = 5_000_000  # of adaptive solvers
MUJOCO_STEPS = (1e-2, 1e-3, 1e-4, 1e-5)
MUJOCO_MOST = 15_000_000  # steps of one run
ROUNDS = 3

LONGEST = 20.0  # no run is repeated after this time [s]

SOLVED, REFUSED, BY_NAME, SILENTLY = OUTCOMES


class Refused(Exception):
    """A named result instead of a motion."""


class Run(NamedTuple):
    """A motion at the output times, and how many steps it took."""

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
    steps: Any = diffrax.PIDController(
        rtol=scene.tolerance,
        atol=scene.tolerance,
        dtmin=1e-13 if jax.config.jax_enable_x64 else 1e-8,
        force_dtmin=False,
    )
    if scene.scaled:
        steps = fj.scale_tolerances(scene.linkage, steps)
    if scene.derivative:
        steps = None  # the default, which bounds the error of derivatives too
    keywords: dict[str, Any] = dict(
        solver=diffrax.Kvaerno5() if scene.stiff else None,
        stepsize_controller=steps,
        dt0=scene.first_step,
        max_steps=MAX_STEPS,
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )

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
    """diffeqsolve on textbook equations, which know nothing of the library."""
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
    integrator = hy.taylor_adaptive(
        symbolic(hy, scene.linkage, scene.driven),
        start,
        tol=max(scene.tolerance, 1e-15),
    )

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
        joint.attrib.update(
            stiffness=repr(float(k)),
            springref=repr(float(rest)),
            damping=repr(float(d)),
        )
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

    def run() -> Run:
        for step in MUJOCO_STEPS:
            result = once(step)
            solved = _judged(scene, result) <= scene.bound
            longer = 10 * result.steps
            if solved or longer > MUJOCO_MOST:
                break
        return result

    return run


def _judged(scene: HardScene, run: Run) -> float:
    with np.errstate(all="ignore"):
        return scene.judge(np.asarray(run.q), np.asarray(run.qd))


ENGINES = {
    "fdof_jax": fdof_jax,
    "plain diffrax": plain_diffrax,
    "MuJoCo RK4": mujoco,
    "heyoka": heyoka,
}


def outcome(scene: HardScene, make: Callable) -> dict:
    """What came of one scene on one engine, as fields of a record."""
    times: list[float] = []
    try:
        run = make(scene)
        while len(times) <= ROUNDS and sum(times) < LONGEST:
            began = time.perf_counter()
            result = run()
            times.append(time.perf_counter() - began)
    except Skipped as reason:
        return {"status": "skipped", "reason": str(reason)}
    except Refused as refusal:
        named = scene.may_refuse and str(refusal) == "ill-conditioned"
        return {"status": REFUSED if named else BY_NAME, "reason": str(refusal)}
    except Exception as failure:
        reason = f"{type(failure).__name__}: {failure}".split("\n")[0][:200]
        return {"status": BY_NAME, "reason": reason}
    first, *later = times
    later = later or [first]
    known = {
        "error": _judged(scene, result),
        "steps": result.steps,
        "times": later,
        "time_min": min(later),
        "time_median": float(np.median(later)),
        "compile_time": max(0.0, first - min(later)),
    }
    if make is not mujoco and (result.steps or 0) > scene.most_steps:
        return {**known, "status": SILENTLY, "reason": "too many steps"}
    right = known["error"] <= scene.bound
    return {**known, "status": SOLVED if right else SILENTLY}


# What is no motion of one arm: the tests that fdof_jax has to pass, and what of it can
# be asked of plain diffrax.
TESTS = {
    18: ("chattering at a limit", "test_stiff_control.py", "chattering"),
    19: ("derivatives at a limit", "test_saturation.py", ""),
    23: ("float32", "test_single_precision.py", ""),
    24: ("jumps, a pulse of 1 us", "test_jumps.py", ""),
    25: ("odd members of a batch", "test_bad_members.py", "members"),
    26: ("out of steps", "test_bad_members.py", "steps or reached"),
    27: ("junk in unused values", "test_unused_values.py", ""),
    28: ("losses at zero error", "test_derivatives.py", "zero or radius"),
    29: ("Hessians of a batch", "test_derivatives.py", "hessians"),
    30: ("malformed input", "test_malformed.py", ""),
}


def tested(file: str, which: str) -> dict:
    """Whether the tests of a scene pass."""
    root = Path(__file__).parent.parent
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m"]
    command += ["slow or not slow", f"tests/hard/{file}", "-k", which]
    done = subprocess.run(
        command, cwd=root, capture_output=True, text=True, check=False
    )
    last = done.stdout.strip().split("\n")[-1]
    return {"status": SILENTLY if done.returncode else SOLVED, "reason": last}


def _clipped() -> float:
    """Scene 19: the derivative of an effort just at its limit, to one side or other."""
    slope = jax.grad(lambda kp: jnp.clip(kp * 0.25, -32.0, 32.0))(128.0) / 0.25
    return min(abs(float(slope)), abs(float(slope) - 1))


def _steps_in_float32() -> float:
    """Scene 23: steps at a tolerance of 1e-8 in float32, over those in float64."""
    steps = []
    for x64 in (False, True):
        with jax.enable_x64(x64):
            steps.append(_plain(hard.load("swing"), 1e-8).stats["num_steps"])
    return float(steps[0] / steps[1])


def _pulse() -> float:
    """Scene 24: the error after a pulse of 1 us."""

    def effort(t):
        return jnp.where((t >= 7.3) & (t < 7.3 + 1e-6), 1e5, 0.0)

    exact = hard.DRIVEN["pulse"]
    scene = hard.free(hard.arm(), hard.START.q, np.array([0, *exact["ts"]]))
    q = _plain(scene, 1e-12, effort).ys[1:, :3]
    return float(np.abs(q - np.array(exact["q"])).max())


def _spoilt() -> float:
    """Scene 25: the derivative in an effort that all share, one member being NaN."""
    q0 = jnp.asarray(hard.START.q) + jnp.zeros((8, 3))
    scene = hard.free(hard.arm(), hard.START.q, np.array([0.0, 0.5]))

    def loss(effort, q0):
        def end(q0):
            moved = scene._replace(state0=fj.State(q0, scene.state0.qd))
            solution = _plain(moved, 1e-9, lambda t: effort, throw=False)
            good = solution.result == diffrax.RESULTS.successful
            return jnp.where(good, solution.ys[-1, 0], 0.0)

        return jnp.sum(jax.vmap(end)(q0))

    slope = jax.jit(jax.grad(loss))
    spoilt, clean = slope(0.0, q0.at[3, 1].set(jnp.nan)), slope(0.0, q0)
    return float(abs(spoilt - clean * 7 / 8) / abs(clean))


def _negative_mass() -> float:
    """Scene 30: whether a tip of -1 kg goes through."""
    scene = hard.free(hard.arm(), hard.START.q, np.array([0.0, 1.0]))
    linkage = eqx.tree_at(lambda a: a.mass, scene.linkage, jnp.array([1.0, 1.0, -1.0]))
    solution = _plain(scene._replace(linkage=linkage), 1e-9, throw=False)
    return float(solution.result == diffrax.RESULTS.successful)


def _plain(scene: Any, tolerance: float, effort: Any = None, throw: bool = True) -> Any:
    rates = make_rates(scene.linkage, jnp.sin, jnp.cos)

    def field(t, y, args):
        rate = jnp.stack(rates(*y))
        if effort is not None:
            inertia = fj.forward_dynamics  # the response to an effort at joint 1
            still = jnp.zeros(3)
            unit = jnp.array([1.0, 0.0, 0.0])
            response = inertia(scene.linkage, y[:3], still, unit) - inertia(
                scene.linkage, y[:3], still, still
            )
            rate = rate.at[3:].add(effort(t) * response)
        return rate

    return diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Dopri8(),
        scene.ts[0],
        scene.ts[-1],
        1e-3,
        jnp.concatenate([jnp.asarray(part, dtype=float) for part in scene.state0]),
        saveat=diffrax.SaveAt(ts=jnp.asarray(scene.ts)),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=MAX_STEPS,
        throw=throw,
    )


PLAIN = {19: (_clipped, 0.0), 23: (_steps_in_float32, 2.0), 24: (_pulse, 1e-8),
         25: (_spoilt, 1e-9), 30: (_negative_mass, 0.0)}  # fmt: skip


def probed(probe: Callable[[], float], bound: float) -> dict:
    """What came of a probe of plain diffrax."""
    try:
        error = probe()
    except Exception as failure:
        return {"status": BY_NAME, "reason": f"{failure}".split("\n")[0][:200]}
    return {"status": SOLVED if error <= bound else SILENTLY, "error": error}


def run(quick: bool) -> Iterator[dict]:
    """One record per scene and engine: `number`, `bound`, and as status an outcome."""
    for scene in motions():
        if quick and scene.number > 3:
            return
        for engine, make in ENGINES.items():
            found = outcome(scene, make)
            yield _record(scene.number, scene.name, engine, scene.bound, found)
    for number, (name, file, which) in TESTS.items():
        yield _record(number, name, "fdof_jax", None, tested(file, which))
        if number in PLAIN:
            probe, bound = PLAIN[number]
            found = probed(probe, bound)
            yield _record(number, name, "plain diffrax", bound, found)


SINGLE = 1e-4, 1e-5, 1e-6  # tolerances
SINGLE_BOUND = 1e-3  # of errors, where float64 is held to less


def run_float32(quick: bool) -> Iterator[dict]:
    """The motions on fdof_jax in float32: which hold, at which tolerance."""
    for scene in motions():
        if quick and scene.number > 3:
            return
        bound = max(scene.bound, SINGLE_BOUND)
        for tolerance in SINGLE:
            asked = scene._replace(tolerance=tolerance, bound=bound)
            found = outcome(asked, fdof_jax)
            yield {
                **_record(scene.number, scene.name, "fdof_jax", bound, found),
                "kind": "tolerance",
                "setting": tolerance,
            }


def _record(number: int, name: str, engine: str, bound: Any, found: dict) -> dict:
    print(f"{number} {name}: {engine} {found['status']}", flush=True)
    return record(
        protocol=PROTOCOL,
        problem=name,
        solver=engine,
        kind=None,
        number=number,
        bound=bound,
        **found,
    )
