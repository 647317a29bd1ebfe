"""The claims of the results page, from the JSON lines: sentences, tables, pictures."""

import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .measure import ENDLESS, EXACT, OUTCOMES, times_at, worst

Points = list[dict]
_MODES = {
    "fdof_jax": "the motion alone", "fdof_jax, forward mode": "forward mode",
    "fdof_jax, reverse mode": "reverse mode",
}  # fmt: skip
ERRORS = (1e-6, 1e-9)
CHAIN_ERROR = 1e-8  # of chains of many joints
EVALUATIONS = 13  # of the equations in a step of Dopri8
OURS = "fdof_jax sweep"

# A contestant looks the same in all pictures. Colours are Okabe and Ito's.
LOOKS = {
    OURS: ("#D55E00", "o"), "fdof_jax": ("#E69F00", "s"), "heyoka": ("#0072B2", "D"),
    "C order 8": ("#000000", "^"), "C RK4": ("#999999", "v"),
    "diffrax, scalars": ("#009E73", "<"), "diffrax, arrays": ("#56B4E9", ">"),
    "MuJoCo RK4": ("#CC79A7", "P"),
}  # fmt: skip


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *(list(row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float | None, digits: int = 2) -> str:
    """Formats a number to some digits, with powers of ten only where they help."""
    if value is None or value != value:
        return "-"
    if value == 0 or 1e-2 <= abs(value) < 1e4:
        return f"{float(f'{value:.{digits}g}'):g}"
    return f"{value:.{digits - 1}e}".replace("e-0", "e-").replace("e+0", "e")


def chosen(points: Points, **values: object) -> Points:
    return [p for p in points if all(p.get(k) == v for k, v in values.items())]


def rate(points: Points, error: float) -> float | None:
    """Returns one contestant's simulated s per s at an error; None if not reached."""
    walls = times_at(points, error)
    return None if walls is None else points[0]["simulated"] / float(np.median(walls))


def ratio(ours: Points, others: Points, error: float) -> str:
    """Returns how often as fast as others: median and quartiles of the rounds."""
    own, other = times_at(ours, error), times_at(others, error)
    if own is None or other is None:
        return "-"
    count = min(len(own), len(other))
    faster = other[:count] / own[:count] * ours[0]["simulated"] / others[0]["simulated"]
    low, middle, high = np.percentile(faster, [25, 50, 75])
    return f"{number(middle)} ({number(low)} to {number(high)})"


def _solvers(points: Points) -> list[str]:
    return list(dict.fromkeys(p["solver"] for p in points if p["status"] != "skipped"))


def _first_call(points: Points) -> str:
    """Returns how much longer the first call of a program took [s]."""
    # What takes steps of given lengths is compiled beforehand.
    known = [p["compile_time"] for p in points if p["times"] and p["kind"] != "step"]
    # First calls of more than that are not repeated to tell what was compilation.
    return f"> {ENDLESS:g}" if None in known else number(max(known, default=None))


def _rates(points: Points, errors: tuple[float, ...], over: str, every: Points) -> str:
    """Returns a table of rates, and of how often as fast `over` is.

    `every`: points of all sizes, as a solver may compile once for several.
    """
    rows = []
    for solver in _solvers(points):
        own = chosen(points, solver=solver)
        cells = [number(rate(own, e)) for e in errors]
        if solver != over:
            cells += [ratio(chosen(points, solver=over), own, e) for e in errors]
        else:
            cells += ["1"] * len(errors)
        rows.append([solver, *cells, _first_call(chosen(every, solver=solver))])
    at = [f"at {number(e, 1)}" for e in errors]
    head = at + [f"{over} over it, {e}" for e in at]
    return table(["simulated s per s", *head, "first call [s]"], rows)


def batches(points: Points) -> str:
    mixed = chosen(points, problem="mixed")
    every = [p for p in points if p["problem"] == "fig5"]
    big = max(p["batch"] for p in every)
    size = 1024 if chosen(every, batch=1024) else big
    same = chosen(every, batch=size)
    sizes = f"{size} triple pendulums", f"{mixed[0]['batch']} random arms of all kinds"
    return (
        f"{sizes[0]}:\n\n{_rates(same, ERRORS, OURS, every)}\n\n"
        f"{_shares(points, same)}\n\n"
        f"{sizes[1]}:\n\n{_rates(mixed, ERRORS, OURS, mixed)}"
    )


def _shares(points: Points, same: Points) -> str:
    """Says how much of a sweep's time the least equations would take."""
    (alone,) = chosen(points, problem="equations alone")
    each = alone["time_median"] / alone["evaluations"]
    shares = []
    for tolerance in (1e-7, 1e-9):
        (own,) = chosen(same, solver=OURS, setting=tolerance)
        steps = own["batch"] * (own["steps"] + own["rejected"])
        share = EVALUATIONS * steps * each / own["time_median"]
        shares.append(f"{100 * share:.0f} % (at a tolerance of {number(tolerance, 1)})")
    return (
        "Compiled by XLA, heyoka's equations of this one arm take "
        f"{number(1e9 * each)} ns an evaluation. A sweep that did nothing but evaluate "
        f"them would still take {' and '.join(shares)} of its time."
    )


def cores(points: Points) -> str:
    rows = []
    for batch in dict.fromkeys(p["batch"] for p in points):
        for problem in dict.fromkeys(p["problem"] for p in points):
            own = chosen(points, batch=batch, problem=problem)
            for way in (OURS, "a process a core"):
                two = chosen(own, solver=way)
                cells = [
                    ratio(two, chosen(own, solver=other), error)
                    for other in ("one core", "heyoka")
                    for error in ERRORS
                ]
                parts = str(batch), problem, way
                label = ", ".join(x for x in parts if x not in ("fig5", OURS))
                rows += [[label, *cells]] * bool(two)
    others = "one core", "heyoka's two threads"
    head = [f"over {o}, at {number(e, 1)}" for o in others for e in ERRORS]
    return table(["members", *head], rows)


def joints(points: Points) -> str:
    rows = []
    for count in dict.fromkeys(p["joints"] for p in points if "joints" in p):
        of = chosen(points, joints=count)
        batch = max(p["batch"] for p in of)
        row = [str(count), number(of[0]["flops"], 4)]
        for members in (1, batch):
            own = chosen(of, batch=members)
            ours = chosen(own, solver="fdof_jax" if members == 1 else OURS)
            row.append(number(rate(ours, CHAIN_ERROR)))
            row += [
                ratio(ours, chosen(own, solver=other), CHAIN_ERROR).split(" ")[0]
                for other in ("heyoka", "MuJoCo RK4")
            ]
        row.append(_first_call(chosen(of, batch=batch, solver=OURS)))
        rows.append(row)
    head = ["joints", "flops"]
    for arms in ("one arm", f"{max(p['batch'] for p in points)} arms"):
        head += [f"{arms} [s per s]", f"{arms} over heyoka", f"{arms} over MuJoCo"]
    return table([*head, "first call [s]"], rows)


def single_arms(points: Points) -> str:
    short = chosen(points, problem="Fig 7, 10 ms")
    way = ", ".join(f"{p['solver']} {number(1e3 * p['time_median'])} ms" for p in short)
    motion = chosen(points, problem="Fig 5, 2 s")
    return f"{_rates(motion, ERRORS, 'fdof_jax', motion)}\n\n10 ms of Fig 7: {way}."


def gradients(points: Points) -> str:
    rows = [
        [str(p["batch"]), _MODES[p["solver"]],
         *map(number, (1e3 * p["time_median"], p["ratio"], p["error"]))]
        for p in points
        if p["status"] == "ok"
    ]  # fmt: skip
    return table(["arms", "", "ms", "over the motion", "error of the gradient"], rows)


def switches(points: Points) -> str:
    """Returns the errors of each way over all scenes at the default tolerance."""
    tolerance = max(p["setting"] for p in points)
    rows = []
    for way in _solvers(points):
        own = chosen(points, solver=way, setting=tolerance)
        errors = np.concatenate([np.asarray(p["errors"], float) for p in own])
        wrong = np.mean(~(errors < 1e-6))
        rows.append([way, str(len(errors)), number(np.median(errors)),
                     number(np.max(errors)), f"{100 * wrong:.2g} %"])  # fmt: skip
    return table(["", "scenes", "median error", "largest", "above 1e-6"], rows)


def held_joints(points: Points) -> str:
    sweeps = [
        f"{number(p['ratio'])} times as long at {p['setting']:g} x (5, 4, 3, 2, 1) N m"
        for p in points
        if p["solver"] == "friction" and p["status"] == "ok"
    ]
    rows = []
    for scene in dict.fromkeys(p["problem"] for p in points if p["kind"] != "level"):
        for solver in ("fdof_jax", "MuJoCo"):
            own = [
                p for p in chosen(points, problem=scene, solver=solver) if p["times"]
            ]
            if not own:
                continue
            # Of settings that are as good as exact the first is the fastest.
            best = min(own, key=lambda p: max(EXACT, worst(p)))
            wall = 1e3 * best["time_median"] / best["simulated"]
            how = f"{best['kind']} {number(best['setting'], 1)}"
            rows.append([scene, solver, how, number(worst(best)), number(wall)])
    head = ["", "", "at its most exact", "error [m or rad]", "ms a simulated s"]
    return f"By friction it takes {', '.join(sweeps)}.\n\n{table(head, rows)}"


def hard_cases(points: Points) -> str:
    outcomes: dict[str, dict[int, str]] = {}
    for point in points:
        if point["status"] != "skipped":
            own = outcomes.setdefault(point["solver"], {})
            both = [point["status"], own.get(point["number"], OUTCOMES[0])]
            own[point["number"]] = max(both, key=OUTCOMES.index)
    count = len({p["number"] for p in points})
    rows = [
        [engine, *(str([*own.values()].count(o)) for o in OUTCOMES),
         str(count - len(own))]
        for engine, own in outcomes.items()
    ]  # fmt: skip
    return table(["", *OUTCOMES, "not asked"], rows)


def compile_times(points: Points) -> str:
    """Each cell has a number for each version of JAX."""
    versions = list(dict.fromkeys(p["versions"]["jax"] for p in points))
    rows, units = [], []
    for case in dict.fromkeys(p["problem"] for p in points):
        cells = []
        for k, version in enumerate(versions):
            new, kept = (
                next(
                    p
                    for p in chosen(points, problem=case, solver=how)
                    if p["versions"]["jax"] == version
                )
                for how in ("new", "programs kept")
            )
            call = new["time_median"] - new["imported"]
            if not rows:
                units.append(call)  # the first case is the pendulum
            cells.append(
                [new["time_median"], call, call / units[k], kept["time_median"]]
                + [1e3 * new["again"]]
            )
        rows.append([case, *(" / ".join(map(number, pair)) for pair in zip(*cells))])
    head = ["JAX " + " / ".join(versions), "process [s]", "first call [s]"]
    head += ["over the pendulum's", "process, programs kept [s]", "second call [ms]"]
    return table(head, rows)


def gpu(points: Points) -> str:
    if not any(p["status"] == "ok" for p in points):
        return "Not measured: no GPU was at hand."
    rows = []
    for batch in dict.fromkeys(p["batch"] for p in points):
        own = chosen(points, batch=batch)
        for solver in _solvers(own):
            rates = [rate(chosen(own, solver=solver), e) for e in ERRORS]
            rows.append([str(batch), solver, *map(number, rates)])
    return table(["members", "", *(f"s per s at {number(e, 1)}" for e in ERRORS)], rows)


CLAIMS: dict[str, Callable[[Points], str]] = {
    "batches": batches, "cores": cores, "joints": joints, "single_arms": single_arms,
    "gradients": gradients, "switches": switches, "held_joints": held_joints,
    "hard_cases": hard_cases, "compile_times": compile_times, "gpu": gpu,
    "gpu-float32": gpu,
}  # fmt: skip


def machine(points: dict[str, Points]) -> str:
    """Returns machine, versions and commit; raises ValueError if there are several."""
    every = [p for rows in points.values() for p in rows]
    commits = {p["commit"] for p in every}
    if len(commits) != 1:
        raise ValueError(
            f"results: expected those of one commit, got {sorted(map(str, commits))}: "
            "measure all again (python -m benchmarks)."
        )
    one, days = every[0], sorted({p["date"] for p in every})
    versions = ", ".join(f"{k} {v}" for k, v in one["versions"].items() if v)
    return f"{one['cpu']}, commit {one['commit']}, {days[0]}; {versions}."


def texts(points: dict[str, Points]) -> dict[str, str]:
    found = {name: CLAIMS[name](rows) for name, rows in points.items() if rows}
    return found | {"machine": machine(points)}


def filled(page: str, new: dict[str, str]) -> str:
    """Returns the page with texts between their markers."""
    for name, text in new.items():
        pattern = rf"(<!-- begin: {name} -->).*?(<!-- end: {name} -->)"
        page, count = re.subn(
            pattern, lambda m, t=text: f"{m[1]}\n\n{t}\n{m[2]}", page, flags=re.DOTALL
        )
        if count != 1:
            raise ValueError(f"page: expected one place for {name!r}, got {count}.")
    return page


# Pictures


def _curve(axes: Axes, solver: str, x: list, y: list) -> None:
    known = [(a, b) for a, b in zip(x, y) if b]
    if known:
        color, marker = LOOKS[solver]
        width = 2 if solver == OURS else 1
        axes.loglog(
            *zip(*known), color=color, marker=marker, ms=4, lw=width, label=solver
        )


def pictures(points: dict[str, Points], folder: Path) -> None:
    same = [p for p in points.get("batches", []) if p["problem"] == "fig5"]
    sizes = sorted({p["batch"] for p in same if p["times"]})
    if not sizes:
        return
    size = 1024 if 1024 in sizes else sizes[-1]
    figure = Figure(figsize=(6.3, 4.2), layout="constrained")
    axes = figure.subplots()
    for solver in LOOKS:
        own = [p for p in chosen(same, batch=size, solver=solver) if p["times"]]
        own.sort(key=lambda p: p["error"])
        rates = [p["simulated"] / p["time_median"] for p in own]
        _curve(axes, solver, [p["error"] for p in own], rates)
    axes.invert_xaxis()
    axes.set_xlabel(f"worst error of {size} triple pendulums [rad], falling")
    axes.set_ylabel("simulated s per s on one core")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8)
    figure.savefig(folder / "error.png", dpi=110)

    chains = points.get("joints", [])
    figure = Figure(figsize=(6.3, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for solver in LOOKS:
        own = [chosen(same, batch=b, solver=solver) for b in sizes]
        _curve(left, solver, sizes, [rate(p, ERRORS[0]) if p else None for p in own])
        counts = range(1, 9)
        most = max((p["batch"] for p in chains), default=1)
        own = [chosen(chains, joints=n, batch=most, solver=solver) for n in counts]
        heights = [rate(p, CHAIN_ERROR) if p else None for p in own]
        _curve(right, solver, list(counts), heights)
    left.set(xlabel="members", title="triple pendulums, error 1e-6")
    right.set(xlabel="joints", title=f"{most} chains, error {number(CHAIN_ERROR, 1)}")
    right.set_xscale("linear")
    for axes in (left, right):
        axes.set_ylabel("simulated s per s on one core")
        axes.grid(alpha=0.3)
        axes.title.set_fontsize(9)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    figure.savefig(folder / "cost.png", dpi=110)
