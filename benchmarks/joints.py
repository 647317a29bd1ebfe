"""The number of joints: cost of hanging chains of one to eight equal rods."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

import fdof_jax as fj
from fdof_jax.mechanics.equations import link_constants, zeros
from fdof_jax.mechanics.rates import rates

from . import contestants as own, peers, taylor
from .contestants import Contestant, cases
from .measure import ENDLESS, Skipped, measure, skipped, times_at
from .problems import Problem, reference
from .tables import number, table

PROTOCOL = "joints"
ERROR = 1e-8  # at which times are read off [rad]
BATCH = 1024
MEMBERS = 16  # of a batch for MuJoCo, which runs them in turn

MASS = LENGTH = 1.0  # of each rod [kg], [m]
GRAVITY = 9.81


def chain(joints: int, batch: int) -> Problem:
    """Returns chains bent by up to half a radian at each joint, at rest, for 2 s.

    The rods are as long in all chains, so that their fastest motions are similar.
    """
    linkage = fj.Linkage(
        "R" * joints,
        length=[0.0] + [LENGTH] * joints,
        com=[[LENGTH / 2, 0.0]] * joints,
        mass=[MASS] * joints,
        inertia=[MASS * LENGTH**2 / 12] * joints,
        base_angle=-np.pi / 2,
        gravity=GRAVITY,
    )
    q = np.random.default_rng(joints).uniform(-0.5, 0.5, (batch, joints))
    ts = np.array([0.0, 2.0])
    name = f"{joints} joints"
    return Problem(name, linkage, fj.State(q, np.zeros_like(q)), (), ts, "R" * joints)


def members(problem: Problem, which: Any) -> Problem:
    """Returns some members of a batch; a single one for an index."""
    return problem._replace(state0=jax.tree.map(lambda a: a[which], problem.state0))


def rods(hy: Any, linkage: fj.Linkage) -> list:
    """Returns a chain of `LENGTH` and `MASS` in heyoka's form, as in a textbook."""
    n = len(linkage.mass)
    q = [hy.make_vars(f"q{k}") for k in range(n)]
    u = [hy.make_vars(f"u{k}") for k in range(n)]
    angle = [hy.sum(q[: k + 1]) for k in range(n)]  # from the vertical
    squared = [hy.sum(u[: k + 1]) ** 2.0 for k in range(n)]
    sin, cos = [hy.sin(a) for a in angle], [hy.cos(a) for a in angle]
    # Rod k has n - 1 - k rods at its end.
    moment = [MASS * LENGTH * (n - 0.5 - k) for k in range(n)]
    matrix: list[list[Any]] = []
    rest = []
    for i in range(n):
        inertia = MASS * LENGTH**2 * (1 / 3 + n - 1 - i)
        row = [LENGTH * moment[i] * (cos[i] * cos[j] + sin[i] * sin[j])
               for j in range(i)]  # fmt: skip
        matrix.append([*row, hy.expression(inertia)])
        pulls = [
            LENGTH * moment[max(i, j)] * (cos[i] * sin[j] - sin[i] * cos[j])
            for j in range(n)
        ]
        thrown = [p * w for j, (p, w) in enumerate(zip(pulls, squared)) if j != i]
        rest.append(hy.sum([*thrown, -GRAVITY * moment[i] * sin[i]]))
    for k in reversed(range(n)):  # elimination from the tip
        for i in range(k):
            factor = matrix[k][i] / matrix[k][k]
            rest[i] = rest[i] - factor * rest[k]
            for j in range(i + 1):
                matrix[i][j] = matrix[i][j] - factor * matrix[k][j]
    bent: list[Any] = []
    for k in range(n):
        known = [matrix[k][j] * bent[j] for j in range(k)]
        bent.append((rest[k] - hy.sum(known)) / matrix[k][k])
    relative = [bent[0], *(b - a for a, b in zip(bent, bent[1:]))]
    return list(zip([*q, *u], [*u, *relative]))


def flops(linkage: fj.Linkage) -> float:
    """Returns the operations of one evaluation of the equations, as lowered."""
    q = linkage.locked
    arguments = link_constants(linkage, q), zeros(q), tuple(q), zeros(q)
    return jax.jit(rates).lower(*arguments).cost_analysis()["flops"]


def _exact(problem: Problem) -> np.ndarray:
    """Returns joint positions at both ends, to about 1e-13."""
    try:
        heyoka = taylor.heyoka(problem, rods, compact=True)
    except Skipped:
        return reference(problem)
    end = heyoka.motion(heyoka.run(1e-15)).q
    return np.concatenate([problem.state0.q[:, None], end], axis=1)


Row = tuple[str, Callable[[Problem], Contestant], tuple, int]


def contestants(batch: int) -> list[Row]:
    """Returns names, contestants, their settings and how many members they run."""
    return [
        ("fdof_jax", own.fdof_jax, (1e-7, 1e-9, 1e-11), batch),
        ("heyoka", partial(taylor.heyoka, equations=rods), (1e-7, 1e-9), batch),
        (
            "MuJoCo RK4",
            partial(peers.mujoco, integrator="RK4"),
            (8e-3, 2e-3, 4e-4),
            min(batch, MEMBERS),
        ),
    ]


def _measured(
    problem: Problem, exact: np.ndarray, batch: int, budget: float
) -> Iterator[dict]:
    prepared = []
    for name, make, settings, count in contestants(batch):
        which: Any = 0 if batch == 1 else slice(count)
        part = members(problem, which)
        try:
            contestant = make(part)
        except Skipped as reason:
            yield skipped(PROTOCOL, name, str(reason))
            continue
        fields = {"simulated": count * float(problem.ts[-1]), "members": count}
        prepared += [
            case._replace(fields=fields)
            for case in cases(contestant, settings, exact[which], part)
        ]
    yield from measure(
        PROTOCOL,
        prepared,
        budget=budget,
        ratio_to="fdof_jax",
        problem=problem.name,
        batch=batch,
        joints=len(problem.linkage.mass),
        flops=flops(problem.linkage),
    )


def run(quick: bool) -> Iterator[dict]:
    most = 16 if quick else BATCH
    for joints in (1,) if quick else range(1, 9):
        problem = chain(joints, most)
        exact = _exact(problem)
        for batch in (1, most):
            yield from _measured(problem, exact, batch, budget=0.5 if quick else 4)


def speed(points: list[dict]) -> float | None:
    """Returns one solver's simulated s per s at `ERROR`."""
    walls = times_at(points, ERROR)
    return None if walls is None else points[0]["simulated"] / float(np.median(walls))


def step_time(points: list[dict]) -> float | None:
    """Returns the time of a member's step, of the run with the most steps [s]."""
    good = [p for p in points if p["times"]]
    if not good:
        return None
    tightest = min(good, key=lambda p: p["setting"])
    count = tightest["members"] * (tightest["steps"] or 0)
    if tightest["kind"] == "step":
        count = tightest["simulated"] / tightest["setting"]
    return tightest["time_median"] / count if count else None


def compile_time(points: list[dict]) -> float | None:
    """Returns the longest time to compile [s]; infinity if it was given up."""
    compiled = [p["compile_time"] for p in points if p["times"]]
    return np.inf if None in compiled else max(compiled, default=None)


def _cells(points: list[dict]) -> list[str]:
    per_step, compiled = step_time(points), compile_time(points)
    return [
        number(speed(points)),
        number(per_step and 1e6 * per_step),
        f"> {ENDLESS:g}" if compiled == np.inf else number(compiled),
    ]


def joints_table(points: list[dict]) -> str:
    """Returns a table per batch size, with a row per number of joints."""
    measured = [p for p in points if p["status"] != "skipped"]
    parts = []
    for batch in dict.fromkeys(p["batch"] for p in measured):
        rows = []
        for joints in dict.fromkeys(p["joints"] for p in measured):
            own_points = [
                [p for p in measured
                 if (p["joints"], p["batch"], p["solver"]) == (joints, batch, solver)]
                for solver in ("fdof_jax", "heyoka", "MuJoCo RK4")
            ]  # fmt: skip
            first, second, third = map(_cells, own_points)
            count = number(own_points[0][0]["flops"], 4)
            rows.append([str(joints), count, *first, second[0], second[2], *third[:2]])
        head = [
            "joints",
            "flops",
            "fdof_jax",
            "a step [µs]",
            "compile [s]",
            "heyoka",
            "compile [s]",
            "MuJoCo RK4",
            "a step [µs]",
        ]
        parts.append(
            f"Batch of {batch}, simulated s per s at a worst error of {ERROR:g}:\n\n"
            + table(head, rows)
        )
    skips = [p for p in points if p["status"] == "skipped"]
    parts += [f"Skipped: {p['solver']}: {p['reason']}." for p in skips]
    return "\n\n".join(dict.fromkeys(parts))
