"""Random arms, states and arguments: nothing may be silently wrong, hang or crash.

`python -m tests.hard.fuzz --cases 10000` draws cases of three kinds and prints what
came of them; `test_fuzz.py` runs 300 in pytest.

A case comes to a named outcome or raises `Failure`. Ill-conditioned arms are judged by
what rounding alone can do to them: the bounds below are computed by the oracle, at the
case, from the sizes of the terms that a computation in float64 has to add up.
"""

import argparse
import collections
import dataclasses
import faulthandler
import math
import random
import re
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import diffrax
import hypothesis
import hypothesis.strategies as st
import jax
import numpy as np

import fdof_jax as fj

from . import garbage, oracle

EPS = float(np.finfo(float).eps)
# Roundings in the longest chain of operations from the inputs to an acceleration.
ROUNDINGS = 8
# Above this share of lost digits first-order bounds of rounding mean nothing.
UNRESOLVED = 0.1
TOLERANCE = 1e-11  # of simulate's default, relative and absolute
MAX_STEPS = 4096
RESULTS = "successful max_steps_reached dt_min_reached singular nonfinite".split()
SLOWEST = 20.0  # [s] of the processor, compilation included: more counts as a hang


class Failure(AssertionError):
    """A wrong answer, a wrong refusal or an error that names nothing."""


@dataclasses.dataclass
class Report:
    """What came of the cases: outcomes by kind, and the worst error over its bound."""

    outcomes: collections.Counter = dataclasses.field(
        default_factory=collections.Counter
    )
    worst: dict = dataclasses.field(default_factory=dict)
    failures: list = dataclasses.field(default_factory=list)
    motions: list = dataclasses.field(default_factory=list)

    def note(self, what: str, value: float, case: Any) -> None:
        if value > self.worst.get(what, (0.0, None))[0]:
            self.worst[what] = (value, case)


# Random arms


def sized(low: float, high: float) -> st.SearchStrategy:
    """Positive numbers, uniform in their logarithm."""
    return st.floats(math.log10(low), math.log10(high)).map(lambda e: 10.0**e)


def signed(low: float, high: float) -> st.SearchStrategy:
    size = sized(low, high)
    return st.one_of(st.sampled_from([0.0, 1.0]), size, size.map(lambda v: -v))


# Near and at the angles where directions align, and after many turns.
ANGLES = st.one_of(
    st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi / 2]),
    st.floats(-4, 4),
    st.builds(
        lambda k, d: k * math.pi / 2 + d, st.integers(-2, 2), signed(1e-12, 1e-2)
    ),
    signed(10, 1e7),
)
TRIPLE = lambda values: st.tuples(values, values, values)
LENGTHS = signed(1e-3, 1e2)


@st.composite
def arms(draw) -> oracle.Arm:
    topology = draw(st.sampled_from(fj.TOPOLOGIES))
    return oracle.Arm(
        topology,
        length=draw(st.tuples(*[LENGTHS] * 4)),
        com=draw(TRIPLE(st.tuples(LENGTHS, LENGTHS))),
        mass=draw(TRIPLE(st.one_of(st.sampled_from([1.0, 0.0]), sized(1e-6, 1e6)))),
        inertia=draw(TRIPLE(st.one_of(st.sampled_from([1.0, 0.0]), sized(1e-6, 1e6)))),
        locked=tuple(draw(LENGTHS if j == "R" else ANGLES) for j in topology),
        base_angle=draw(ANGLES),
        gravity=draw(st.one_of(st.sampled_from([9.81, 0.0]), signed(1e-3, 1e3))),
    )


@dataclasses.dataclass(frozen=True)
class Scene:
    arm: oracle.Arm
    q: tuple
    qd: tuple
    tau: tuple
    junk: float  # effort on fictitious joints, which must not matter
    damping: tuple
    pace: float  # how far the fastest joint goes in a simulation [m or rad], or so
    t0: float


@st.composite
def scenes(draw) -> Scene:
    arm = draw(arms())
    return Scene(
        arm,
        q=tuple(draw(ANGLES if j == "R" else LENGTHS) for j in arm.topology),
        qd=draw(st.one_of(st.just((0.0,) * 3), TRIPLE(signed(1e-3, 1e4)))),
        tau=draw(st.one_of(st.just((0.0,) * 3), TRIPLE(signed(1e-3, 1e6)))),
        junk=draw(signed(1, 1e6)),
        damping=draw(
            st.one_of(
                st.just((0.0,) * 3),
                TRIPLE(st.one_of(st.just(0.0), sized(1e-3, 1e3))),
            )
        ),
        pace=draw(sized(1e-2, 30)),
        t0=draw(st.sampled_from([0.0, -3.0, 100.0])),
    )


def linkage_of(arm: oracle.Arm) -> fj.Linkage | None:
    """The library's own, None if it refuses and is right to."""
    try:
        linkage = fj.Linkage(
            arm.topology,
            length=arm.length,
            com=arm.com,
            mass=arm.mass,
            inertia=arm.inertia,
            locked=arm.locked,
            base_angle=arm.base_angle,
            gravity=arm.gravity,
        )
    except ValueError as error:
        if not str(error).startswith("mass, inertia, com: expected joint"):
            raise Failure(f"refused for another reason: {error}") from error
        return None
    return linkage


def resolution(a: oracle.Acceleration) -> float:
    """The share of the acceleration that rounding takes, to first order.

    Every entry of M is wrong by some roundings of the product of its joints' levers,
    so the relative error of M^-1 is that times M^-1 scaled by the levers: about
    eps / min rho if no lengths cancel, eps / (rho_1 rho_2) at worst.
    """
    if a.qdd is None:
        return math.inf
    scaled = max(
        abs(a.inverse[i][j]) * a.levers[i] * a.levers[j]
        for i in range(3)
        for j in range(3)
    )
    return ROUNDINGS * EPS * (1 + a.angles) * scaled


def rounding_bound(a: oracle.Acceleration) -> list[float]:
    """|M^-1| (|terms of tau - bias| + |terms of M| |qdd|) eps times some roundings.

    Holds for every computation whose sums are made of these terms, among them the
    solution without pivoting of a positive definite system. An absolute angle is right
    to an ulp of the angles it is the sum of, hence `angles`.
    """
    assert a.qdd is not None
    carried = sum(s * abs(float(x)) for s, x in zip(a.levers, a.qdd))
    terms = [f + s * carried for f, s in zip(a.efforts, a.levers)]
    return [
        ROUNDINGS * EPS * (1 + a.angles) * sum(abs(m) * t for m, t in zip(row, terms))
        + 1e-300
        for row in a.inverse
    ]


def never_determined(arm: oracle.Arm) -> str | None:
    """Whether some joint moves no inertia in any configuration: why refusing is right.

    Or not to 13 digits: the door works in float64.
    """
    rng = random.Random(0)
    reach = sum(map(abs, arm.length)) + sum(abs(c) for pair in arm.com for c in pair)
    found = []
    for _ in range(6):
        q = [
            rng.uniform(-3, 3) if j == "R" else rng.uniform(-1, 1) * (reach or 1)
            for j in arm.topology
        ]
        a = oracle.acceleration(arm, q, (0.0,) * 3, (0.0,) * 3)
        found.append(a)
    if all(a.qdd is None for a in found):
        return "refused: always singular"
    if all(a.qdd is None or _scaled_inverse(a) > 1e13 for a in found):
        return "refused: singular to 13 digits"
    return None


def _scaled_inverse(a: oracle.Acceleration) -> float:
    size = [math.sqrt(a.matrix[k][k]) for k in range(3)]
    return max(
        abs(a.inverse[i][j]) * size[i] * size[j] for i in range(3) for j in range(3)
    )


def refusal(arm: oracle.Arm) -> str:
    reason = never_determined(arm)
    if reason is None:
        raise Failure("refused, though every joint moves inertia somewhere")
    return reason


# (a) Accelerations


def check_accelerations(scene: Scene, report: Report) -> str:
    arm = scene.arm
    linkage = linkage_of(arm)
    if linkage is None:
        return refusal(arm)
    exact = oracle.acceleration(arm, scene.q, scene.qd, scene.tau)
    if min(exact.rho) == 0 and never_determined(arm) == "refused: always singular":
        raise Failure("accepted, though singular in all configurations")
    reduced = np.asarray(fj.forward_dynamics(linkage, scene.q, scene.qd, scene.tau))
    told = _told_ill_conditioned(linkage, scene, exact)
    outcome = _judge("reduced", reduced, exact, told, scene, report)

    x, xd = (np.asarray(v).tolist() for v in fj.to_chain(linkage, scene.q, scene.qd))
    exact = oracle.acceleration_of_chain(arm, x, xd, scene.tau)
    force = []
    for joint, tau in zip(arm.topology, scene.tau):
        force += [scene.junk, tau] if joint == "R" else [tau, scene.junk]
    xdd = np.asarray(fj.masked_accelerations(linkage, x, xd, force))
    slide, turn = xdd[0::2], np.diff(xdd[1::2], prepend=0)
    real = [joint == "R" for joint in arm.topology]
    if np.isfinite(xdd).all():
        still = np.where(real, slide, turn)
        # What the terms alone would accelerate, too: they may cancel.
        terms = [f / s**2 for f, s in zip(exact.efforts, exact.levers)]
        size = max(*terms, np.abs(xdd).max())
        if (np.abs(still) > ROUNDINGS * EPS * size).any():
            raise Failure(f"masked: fictitious joints accelerate by {still}")
    masked = np.where(real, turn, slide)
    # The absolute angular accelerations carry their own rounding.
    spread = EPS * np.abs(xdd[1::2]).max()
    _judge("masked", masked, exact, told, scene, report, spread)
    return outcome


def _told_ill_conditioned(linkage, scene: Scene, exact) -> bool:
    """Whether `inertia_ratios` says so; its own error is checked."""
    ratios = np.asarray(fj.inertia_ratios(linkage, scene.q))
    if exact.qdd is not None and resolution(exact) < 1e-3:
        expected = [
            float(1 / (exact.matrix[k][k] * exact.inverse[k][k])) for k in range(3)
        ]
        if not np.abs(ratios - expected).max() <= 1e-3:
            raise Failure(f"inertia_ratios: {ratios}, not {expected}")
    return bool(ratios.min() < 1e-9)


def _judge(name, value, exact, told, scene, report, spread=0.0) -> str:
    lost = resolution(exact)
    if lost >= UNRESOLVED:
        # The bound means nothing; but who is wrong by much must have been told.
        if told:
            return "unresolved by float64, told"
        if not np.isfinite(value).all():
            return "unresolved by float64, not finite"
        wrong = _relative_error(value, exact)
        if wrong > 0.1:
            raise Failure(
                f"{name}: wrong by {wrong:.1g} of its size and nobody says so, rho "
                f"{exact.rho}: {value}"
            )
        return "unresolved by float64, right to 10 %"
    for got, right, bound in zip(value, exact.qdd, rounding_bound(exact)):
        if not math.isfinite(got):
            raise Failure(f"{name}: {value} instead of {list(map(float, exact.qdd))}")
        error = float(abs(oracle.mp.mpf(float(got)) - right))
        report.note(f"{name} acceleration / bound", error / (bound + spread), scene)
        if error > bound + spread:
            raise Failure(
                f"{name}: {value} instead of {list(map(float, exact.qdd))}, error "
                f"{error:.3g} for a bound of {bound + spread:.3g}, rho {exact.rho}"
            )
    return "right"


def _relative_error(value, exact: oracle.Acceleration) -> float:
    """In the norm of the levers, which makes all joints comparable."""
    if exact.qdd is None:
        return math.inf
    pairs = list(zip(exact.levers, value, map(float, exact.qdd)))
    return max(s * abs(a - b) for s, a, b in pairs) / (
        max(s * abs(b) for s, _, b in pairs) + 1e-300
    )


# (b) Motions


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
    report.motions.append((scene, ts, name, q, qd))
    finite = np.isfinite(np.concatenate([q, qd], axis=1)).all(axis=1)
    # From 1 ms in steps of a fifth, nothing takes so many to begin with.
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
    _check_energy(scene, ts[:good], q[:good], qd[:good], steps, report)
    return name


def result_name(result: Any) -> str:
    names = [n for n in RESULTS if bool(result == getattr(diffrax.RESULTS, n))]
    if len(names) != 1:
        raise Failure(f"a result of no known name: {result}")
    return names[0]


def _check_energy(scene: Scene, ts, q, qd, steps: int, report: Report) -> None:
    """Energy less the work of constant efforts: kept, or lost where there is damping.

    The bound lets each step be wrong by the tolerance in every coordinate, and each
    evaluation by its roundings: what that does to the energy is given by its
    derivatives, of which `levers` and `efforts` hold the sizes.
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
        with oracle.mpmath.workdps(30):
            work = sum(f * (x - y) for f, x, y in zip(scene.tau, q[k], scene.q))
            change = float(oracle.energy(scene.arm, *state) - first - work)
        gain = change - last if any(scene.damping) else abs(change)
        last = change
        report.note("energy / bound", gain / (bound + 1e-300), scene)
        if gain > bound + 1e-300:
            raise Failure(
                f"energy changes by {gain:.3g} J at {ts[k]}, bound {bound:.3g} J, "
                f"{steps} steps"
            )


def check_state(scene: Scene, ts, q, qd, report: Report) -> str:
    """States against a run at 30 digits; the bound is what small changes would do.

    Two more runs start as far off as the tolerance allows, with parameters wrong in
    their last digits, all with random signs.
    """

    def states(arm, q, qd):
        rows = oracle.motion(arm, q, qd, scene.tau, scene.damping, ts.tolist())
        return [[oracle.mp.mpf(x) for x in row] for row in rows]

    rng = random.Random(0)

    def off(values, share, floor=0.0):
        return tuple(v + rng.choice([-1, 1]) * share * (floor + abs(v)) for v in values)

    try:
        exact = states(scene.arm, scene.q, scene.qd)
        bound = TOLERANCE * (1 + np.abs(np.array(exact, dtype=float)))
        for _ in range(2):
            arm = scene.arm
            other = states(
                arm._replace(
                    length=off(arm.length, ROUNDINGS * EPS),
                    com=tuple(off(pair, ROUNDINGS * EPS) for pair in arm.com),
                    mass=off(arm.mass, ROUNDINGS * EPS),
                    inertia=off(arm.inertia, ROUNDINGS * EPS),
                    locked=off(arm.locked, EPS),
                    base_angle=off([arm.base_angle], EPS)[0],
                ),
                [
                    oracle.mp.mpf(a) + b
                    for a, b in zip(scene.q, off((0,) * 3, TOLERANCE, 1))
                ],
                off(scene.qd, TOLERANCE, 1.0),
            )
            bound += [
                [float(abs(a - b)) for a, b in zip(*rows)] for rows in zip(exact, other)
            ]
    except oracle.MotionTooLong:
        return "state: reference too long"
    bound = 10 * np.maximum.accumulate(bound)
    got = np.concatenate([q, qd], axis=1)
    error = np.array(
        [
            [float(abs(oracle.mp.mpf(float(a)) - b)) for a, b in zip(*rows)]
            for rows in zip(got, exact)
        ]
    )
    report.note("state / bound", (error / bound).max(), scene)
    if (error > bound).any():
        raise Failure(f"states wrong by {error.max(0)}, bound {bound.max(0)}")
    return "state: right"


# Running them


def check_argument(case: Any, report: Report) -> str:
    return garbage.check(case, Failure)


KINDS: dict[str, tuple[st.SearchStrategy, Callable[[Any, Report], str], float]] = {
    "accelerations": (scenes(), check_accelerations, 0.5),
    "motions": (scenes(), check_motion, 0.3),
    "arguments": (garbage.cases(), check_argument, 0.2),
}


def check(kind: str, case: Any, report: Report) -> None:
    """Run one case; raise `Failure` for whatever is not a named outcome."""
    before = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # arms that may be singular somewhere
        try:
            outcome = KINDS[kind][1](case, report)
        except Failure:
            raise
        except Exception as error:
            raise Failure(f"{type(error).__name__}: {str(error)[:300]}") from error
    seconds = time.process_time() - before
    report.note(f"seconds, {kind}", seconds, case)
    if seconds > SLOWEST:
        raise Failure(f"took {seconds:.0f} s")
    report.outcomes[kind, outcome] += 1


def run(kind: str, cases: int, report: Report, *, seed: int | None = None) -> None:
    """Draw cases of a kind; without a seed always the same ones, and raise failures."""

    def one(case):
        try:
            check(kind, case, report)
        except Failure as failure:
            if seed is None:
                raise  # and let hypothesis find a simpler case
            report.outcomes[kind, "FAILED"] += 1
            report.failures.append((kind, failure, case))

    phases = [hypothesis.Phase.generate]
    drawn = hypothesis.settings(
        max_examples=cases,
        deadline=None,
        database=None,
        derandomize=seed is None,
        phases=phases + [hypothesis.Phase.shrink] * (seed is None),
        suppress_health_check=list(hypothesis.HealthCheck),
    )(hypothesis.given(KINDS[kind][0])(one))
    if seed is not None:
        drawn = hypothesis.seed(seed)(drawn)
    drawn()


def check_sample(report: Report, sample: int) -> None:
    """States of the first motions that are short enough, against the reference."""
    for scene, ts, name, q, qd in report.motions:
        if sample == 0:
            break
        if name != "successful" or scene.pace > 3:
            continue
        sample -= 1
        try:
            outcome = check_state(scene, ts, q, qd, report)
        except Failure as failure:
            outcome = "FAILED"
            report.failures.append(("motions", failure, scene))
        report.outcomes["motions", outcome] += 1


def check_sweep(report: Report) -> None:
    """The same arms in one `sweep`, each as if it were alone."""
    found = [scene for scene, *_ in report.motions]
    if not found:
        return

    def stack(items):
        return jax.tree.map(lambda *leaves: np.stack(leaves), *items)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        members = [
            (linkage_of(s.arm), fj.State(np.array(s.q), np.array(s.qd)), forces_of(s))
            for s in found
        ]
    ts = np.linspace(0, 0.01, 5)
    settings = dict(max_steps=MAX_STEPS, throw=False)
    linkages, states, forces = map(stack, zip(*members))
    together = fj.sweep(linkages, states, ts, forces, forces_axes=0, **settings)
    rows = np.concatenate([together.q, together.qd], axis=2)
    for k, (linkage, state, force) in enumerate(members):
        alone = fj.simulate(linkage, state, ts, force, **settings)
        name = jax.tree.map(lambda leaf, k=k: leaf[k], together.result)
        names = result_name(alone.result), result_name(name)
        row = np.concatenate([alone.q, alone.qd], axis=1)
        outcome = f"sweep: {names[1]}, as alone"
        if names[0] != names[1]:
            # Rounding differs between the two programs, and so may the last step.
            outcome = f"sweep: {names[1]}, alone {names[0]}"
        elif names[0] == "successful":
            difference = np.abs(rows[k] - row) / (1 + np.abs(row))
            report.note("sweep / alone", difference.max(), found[k])
        report.outcomes["motions", outcome] += 1


def table(report: Report) -> str:
    lines = ["kind           outcome                                   cases"]
    for (kind, outcome), count in sorted(report.outcomes.items()):
        lines.append(f"{kind:<14} {outcome:<40} {count:>6}")
    lines += ["", "worst"]
    for what, (value, _) in sorted(report.worst.items()):
        lines.append(f"{what:<40} {value:.3g}")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=KINDS, help="only these")
    parser.add_argument("--sample", type=int, default=None, help="states checked")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # A hang in compiled code cannot be interrupted, but it can be shown.
    faulthandler.dump_traceback_later(7200, exit=True)
    report = Report()
    for kind, (_, _, share) in KINDS.items():
        if arguments.kind in (None, kind):
            cases = int(share * arguments.cases)
            run(kind, cases, report, seed=arguments.seed)
    sample = arguments.sample
    check_sample(report, arguments.cases // 200 if sample is None else sample)
    check_sweep(report)
    print(table(report))
    kinds = collections.defaultdict(list)
    for kind, failure, case in report.failures:
        words = re.sub(r"[^a-zA-Z_. ].*", "", str(failure).partition(":")[2]).split()
        group = kind, str(failure).partition(":")[0], " ".join(words[:4])
        kinds[group].append((len(repr(case)), str(failure), repr(case)))
    for (kind, *_), found in sorted(kinds.items()):
        _, failure, case = min(found)  # the shortest is the easiest to read
        print(f"\n{len(found)} of {kind}: {failure}\n{case}")
    print(f"\n{len(report.failures)} failures")
    return bool(report.failures)


if __name__ == "__main__":
    sys.exit(main())
