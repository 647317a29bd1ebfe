"""Motions of random arms: named ends, and energies."""

import math
from typing import Any

import diffrax
import numpy as np

import fdof_jax as fj

from . import oracle
from .fuzz_report import Failure, Report
from .oracle import EPS, ROUNDINGS
from .random_scenes import Scene
from .refusals import linkage_of, refusal

TOLERANCE = 1e-11  # the default of simulate, relative and absolute
INTERPOLATED = 30  # times the error of steps, at most, between them
MAX_STEPS = 4096
RESULTS = "successful max_steps_reached dt_min_reached singular nonfinite".split()


def duration(scene: Scene, a: oracle.Acceleration) -> float:
    rate = max(map(abs, scene.qd))
    if a.qdd is not None:
        rate += math.sqrt(max(abs(float(x)) for x in a.qdd))
    return min(max(scene.pace / (rate or 1), 1e-8), 1e2)


def forces_of(scene: Scene) -> tuple:
    return (fj.JointEffort(scene.tau), fj.JointDamper(scene.damping))


def check_motion(scene: Scene, report: Report) -> str:
    linkage = linkage_of(scene.arm)
    if linkage is None:
        return refusal(scene.arm)
    start = oracle.acceleration(scene.arm, scene.q, scene.qd, scene.tau)
    ts = scene.t0 + duration(scene, start) * np.linspace(0, 1, 5)
    solution = fj.simulate(
        linkage,
        fj.State(scene.q, scene.qd),
        ts,
        forces_of(scene),
        max_steps=MAX_STEPS,
        throw=False,
    )
    name = result_name(solution.result)
    q, qd = np.asarray(solution.q), np.asarray(solution.qd)
    steps = int(solution.stats["num_steps"])
    finite = np.isfinite(np.concatenate([q, qd], axis=1)).all(axis=1)
    # No motion needs so many first steps, from 1 ms down by factors of five.
    if steps > 100 and not int(solution.stats["num_accepted_steps"]):
        raise Failure(f"{name}: {steps} steps and none accepted")
    if name != "successful":
        nan = np.isnan(np.concatenate([q, qd], axis=1)).all(axis=1)
        if (
            not (finite | nan).all()
            or nan[0]
            or (np.diff(finite.astype(int)) > 0).any()
        ):
            raise Failure(f"{name}, and states {q.tolist()}")
        if "time_reached" in solution.stats:
            reached = float(solution.stats["time_reached"])
            if not (finite == (ts <= reached)).all():
                raise Failure(f"{name}, reached {reached} of {ts.tolist()}: {finite}")
        elif nan.sum() == 0:
            raise Failure(f"{name}, and no state is NaN")
    elif not finite.all():
        raise Failure(f"successful, and states {q.tolist()}")
    # Processors that flush subnormal numbers to zero may do so.
    off = np.abs(np.concatenate([q[0] - scene.q, qd[0] - scene.qd]))
    if (off > np.finfo(float).tiny).any():
        raise Failure(f"starts at {q[0]}, {qd[0]}")
    good = int(finite.sum())
    _check_energy(scene, ts[:good], q[:good], qd[:good], ts[-1], steps, report)
    return name


def result_name(result: Any) -> str:
    names = [n for n in RESULTS if bool(result == getattr(diffrax.RESULTS, n))]
    if len(names) != 1:
        raise Failure(f"a result of no known name: {result}")
    return names[0]


def _check_energy(scene: Scene, ts, q, qd, end, steps: int, report: Report) -> None:
    """Checks the energy less the work of constant efforts; damping may reduce it.

    The bound allows each step an error of the tolerance in every coordinate, times
    `INTERPOLATED` between steps, and each evaluation its roundings. The derivatives
    of the energy, whose sizes are `levers` and `efforts`, give the effect on it.
    """
    first = oracle.energy(scene.arm, scene.q, scene.qd)
    bound, last = 0.0, 0.0
    for k in range(1, len(ts)):
        state = q[k].tolist(), qd[k].tolist()
        a = oracle.acceleration(scene.arm, *state, scene.tau, digits=30)
        momentum = sum(s * abs(v) for s, v in zip(a.levers, state[1]))
        qdd = a.qdd or (0.0,) * 3
        carried = sum(s * abs(float(x)) for s, x in zip(a.levers, qdd))
        by_tolerance = by_rounding = 0.0
        for s, effort, position, begin, rate in zip(
            a.levers, a.efforts, state[0], scene.q, state[1]
        ):
            moved = abs(position - begin)
            by_tolerance += s * momentum * (1 + abs(rate)) + effort * (1 + moved)
            by_rounding += effort * abs(position) + s * momentum * abs(rate)
            by_rounding += abs(rate) * (effort + s * carried) * (ts[-1] - ts[0])
        rounding = ROUNDINGS * EPS * (1 + a.angles) * by_rounding
        bound = max(bound, TOLERANCE * steps * by_tolerance + rounding)
        between = TOLERANCE * INTERPOLATED * by_tolerance if ts[k] < end else 0.0
        with oracle.mpmath.workdps(30):
            work = sum(f * (x - y) for f, x, y in zip(scene.tau, q[k], scene.q))
            change = float(oracle.energy(scene.arm, *state) - first - work)
        gain = change - last if any(scene.damping) else abs(change)
        last = change
        allowed = bound + between + 1e-300
        report.note("energy / bound", gain / allowed, scene)
        if gain > allowed:
            raise Failure(
                f"energy changes by {gain:.3g} J at {ts[k]}, bound {allowed:.3g} J, "
                f"{steps} steps"
            )
