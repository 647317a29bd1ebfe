"""The tables of the results page, from the JSON lines."""

import re
from collections.abc import Callable

import numpy as np

from .hard_tables import hard_cases, hard_cases_float32
from .markdown import number, table
from .measure import TARGETS, times_at
from .scaling import slope
from .targets import targets


def _solvers(points: list[dict]) -> list[str]:
    return list(dict.fromkeys(p["solver"] for p in points))


def _read_off(points: list[dict], to_value: Callable, sign: str) -> list[str]:
    """Returns a cell per target error; `sign` marks bounds without looser points."""
    cells = []
    loosest = max((p["error"] for p in points if p["times"]), default=0)
    for target in TARGETS:
        walls = times_at(points, target)
        if walls is None:
            cells.append("-")
        else:
            bound = f"{sign} " if target > loosest else ""
            cells.append(bound + number(to_value(float(np.median(walls)))))
    return cells


_ERRORS = [f"{target:g}" for target in TARGETS]


def _by_solver(points: list[dict], to_value: Callable, sign: str) -> str:
    rows = []
    for solver in _solvers([p for p in points if p["status"] != "skipped"]):
        own = [p for p in points if p["solver"] == solver]
        first = max((p["compile_time"] or 0 for p in own), default=0)
        failed = [f"{p['setting']:g}" for p in own if p["status"] == "failed"]
        rows.append(
            [solver, *_read_off(own, to_value, sign), number(first), ", ".join(failed)]
        )
    text = table(["", *_ERRORS, "compile [s]", "failed at"], rows)
    skips = [p for p in points if p["status"] == "skipped"]
    return text + "".join(f"\n\nSkipped: {p['solver']}: {p['reason']}." for p in skips)


def batches(points: list[dict]) -> str:
    parts = []
    for batch in dict.fromkeys(p["batch"] for p in points if p["status"] != "skipped"):
        own = [p for p in points if p["batch"] == batch and p["status"] != "skipped"]
        simulated = next((p["simulated"] for p in own if "simulated" in p), None)
        text = _by_solver(own, lambda wall, s=simulated: s / wall, "≥")
        parts.append(
            f"Batch of {batch}, simulated s per s at a worst error of:\n\n{text}"
        )
    parts += [
        f"Skipped: {p['solver']}: {p['reason']}."
        for p in points
        if p["status"] == "skipped"
    ]
    return "\n\n".join(dict.fromkeys(parts))


def trajectory(points: list[dict]) -> str:
    parts = []
    for problem in dict.fromkeys(p["problem"] for p in points):
        own = [p for p in points if p["problem"] == problem]
        motions = next((p["motions"] for p in own if "motions" in p), 1)
        text = _by_solver(own, lambda wall, m=motions: 1e3 * wall / m, "≤")
        parts.append(f"{problem}, ms per motion at an error of:\n\n{text}")
    return "\n\n".join(parts)


def _ratio(point: dict) -> list[str]:
    quartiles = point["ratio_quartiles"] or [None, None]
    return [number(point["ratio"], 3), " to ".join(number(q, 3) for q in quartiles)]


def generality(points: list[dict]) -> str:
    rows = [
        [
            p["problem"],
            p["solver"],
            number(1e9 * p["time_median"] / p["member_steps"], 3),
            *_ratio(p),
        ]
        for p in points
        if p["times"]
    ]
    head = ["problem", "", "ns per member and step", "ratio", "quartiles"]
    return table(head, rows)


def gradients(points: list[dict]) -> str:
    rows = [
        [
            p["problem"],
            str(p["parameters"]),
            str(p["batch"]),
            f"{p['horizon']:g}",
            number(p["setting"]),
            number(p["longest_step"]),
            p["gradient_mode"],
            number(p["time_median"] and 1e3 * p["time_median"], 3),
            *_ratio(p),
            number(p["error"]),
            number(p["compile_time"]),
            p["reason"] or "",
        ]
        for p in points
    ]
    head = [
        "parameters", "number", "batch", "horizon [s]", "tolerance",
        "steps up to [s]", "mode", "ms",
        "over forward", "quartiles", "gradient error", "compile [s]", "failed",
    ]  # fmt: skip
    return table(head, rows)


def single_arms(points: list[dict]) -> str:
    rows = [
        [
            p["problem"],
            p["solver"],
            number(p["setting"]),
            number(p["time_median"] and 1e3 * p["time_median"], 3),
            *_ratio(p),
            p["ratio_to"] or "",
            number(p["error"]),
            p["reason"] or "",
        ]
        for p in points
    ]
    head = ["", "", "tolerance", "ms", "ratio", "quartiles", "to", "error", "failed"]
    return table(head, rows)


def compile_times(points: list[dict]) -> str:
    rows = []
    for p in points:
        again = 1e3 * np.median(p["again"]) if p["times"] else None
        seconds = number(p["time_median"], 3), number(p["compile_time"], 3)
        rows.append([p["problem"], p["solver"], *seconds, number(again, 3)])
        rows[-1].append(p["reason"] or "")
    head = "of a process [s]", "of the first call [s]", "second call [ms]", "failed"
    return table(["", "", *head], rows)


def scaling(points: list[dict]) -> str:
    rows = []
    for series in dict.fromkeys(p["problem"] for p in points):
        own = [p for p in points if p["problem"] == series and p["times"]]
        exponent = slope(own)
        spans = " to ".join(number(p["x"]) for p in (own[0], own[-1])) if own else "-"
        rows.append(
            ["1/error" if series == "error" else series, spans, number(exponent)]
        )
    return table(["time against", "from", "exponent"], rows)


def drift(points: list[dict]) -> str:
    rows = [
        [
            p["solver"],
            f"{p['kind']} {p['setting']:g}" if p["setting"] else "",
            number(p["time_median"], 3),
            number(p["energy_defect"]),
            p["reason"] or "",
        ]
        for p in points
    ]
    return table(["", "setting", "s", "largest energy error [J]", "failed"], rows)


def lockstep(points: list[dict]) -> str:
    rows = [
        [
            p["solver"],
            number(p["time_median"] and 1e3 * p["time_median"], 3),
            *_ratio(p),
            number(p["steps"], 3),
            number(p.get("steps_max"), 4),
            number(p.get("waste")),
            p["reason"] or "",
        ]
        for p in points
    ]
    head = [
        "",
        "ms",
        "over clean",
        "quartiles",
        "mean steps",
        "most",
        "most/mean",
        "failed",
    ]
    return table(head, rows)


def tuning(points: list[dict]) -> str:
    timed = [
        [
            p["problem"],
            # An earlier row compiled this program.
            number(p["compile_time"]) if p["compile_time"] > 1 else "-",
            number(p["time_median"], 3),
            number(p["time_median"] / p["batch"], 3),
            f"{100 * p['near']:.0f} %",
        ]
        for p in points
        if p["kind"] == "time"
    ]
    seconds_of = {p["problem"]: p["time_median"] for p in points if p["kind"] == "time"}
    *_, one, every = seconds_of.values()
    ratio = (
        f"Seven topologies with all their starts take {every / one:.0f} times as long "
        "as one with one start."
    )
    robust = [
        [p["problem"], p["solver"], *(number(v, 4) for v in p["worst"].values())]
        for p in points
        if p["kind"] == "robust"
    ]
    races = [p for p in points if p["kind"] == "race"]
    limits = list(races[0]["best"]) if races else []
    raced = [
        [p["problem"], p["solver"], *(number(p["best"][limit], 4) for limit in limits)]
        for p in races
    ]
    head = ["", "compile [s]", "s", "s per start", "starts within 1 % of the best"]
    seconds = [f"{limit} s" for limit in limits]
    return "\n\n".join(
        [
            table(head, timed),
            ratio,
            "Worst rms tip error [mm] over 64 members, of gains tuned for the nominal "
            "scene, for 16 other members, and, as a bound, for these 64 themselves:",
            table(["", "controller", "nominal", "robust", "bound"], robust),
            "Best rms tip error [mm] after so many seconds, median of the starts:",
            table(["", "optimiser", *seconds], raced),
        ]
    )


def many(points: list[dict]) -> str:
    rows = [
        [
            p["problem"],
            number(p["time_median"], 3),
            number(p["steps"], 3),
            str(p["steps_max"]),
            str(p["successful"]),
            number(p["against_singles"]),
            f"{p['memory_before_mb']:.0f}",
            f"{p['memory_peak_mb']:.0f}",
            f"{p['saved_mb']:.0f}",
        ]
        for p in points
    ]
    head = [
        "scenes", "s", "mean steps", "most", "successful", "off single motions by",
        "memory before [MB]", "at most [MB]", "of it results [MB]",
    ]  # fmt: skip
    return table(head, rows)


def sliders(points: list[dict]) -> str:
    rows = [
        [
            p["problem"],
            str(len(p["times"])),
            number(1e3 * p["time_median"], 3),
            number(1e3 * p["time_95"], 3),
            f"{100 * p['under_100_ms']:.1f} %",
        ]
        for p in points
        if p["times"]
    ]
    moves = [t for p in points if not p["problem"].startswith("between")
             for t in p["times"]]  # fmt: skip
    if moves:
        median, most = (number(1e3 * np.quantile(moves, q), 3) for q in (0.5, 0.95))
        share = f"{100 * np.mean(np.array(moves) < 0.1):.1f} %"
        rows.append(["all moves", str(len(moves)), median, most, share])
    head = ["", "pictures", "median [ms]", "95 % within [ms]", "under 100 ms"]
    return table(head, rows)


def _machine(points: dict[str, list[dict]]) -> str:
    """Returns a line per machine and versions, with the jobs and their commits."""
    jobs: dict[str, dict[str, set[str]]] = {}
    for name, job in points.items():
        for point in job:
            versions = [f"{k} {v}" for k, v in point["versions"].items() if v]
            commits = jobs.setdefault(", ".join([point["cpu"], *versions]), {})
            # Uncommitted changes may be results of earlier jobs.
            commits.setdefault(point["commit"].removesuffix("-dirty"), set()).add(name)
    lines = []
    for machine, commits in jobs.items():
        runs = "; ".join(
            f"{', '.join(sorted(names))} at commit {commit}"
            for commit, names in sorted(commits.items(), key=lambda item: -len(item[1]))
        )
        lines.append(f"- {machine}: {runs}.")
    return "\n".join(lines)


_NOT_MEASURED = "Not measured: no GPU was at hand."


def _gpu(points: list[dict]) -> str:
    measured = [p for p in points if p["status"] != "skipped"]
    return batches(measured) if measured else _NOT_MEASURED


def tables(points: dict[str, list[dict]]) -> dict[str, str]:
    """Returns the text of each table that has been measured, by name."""
    makers = {
        "batches": batches,
        "batches-xla-flags": batches,
        "batches-two-cores": batches,
        "batches-two-devices": batches,
        "batches-float32": batches,
        "batches-gpu": _gpu,
        "batches-gpu-float32": _gpu,
        "mixed": batches,
        "many": many,
        "trajectory": trajectory,
        "generality": generality,
        "checks": generality,
        "gradients": gradients,
        "single_arms": single_arms,
        "compile_times": compile_times,
        "scaling": scaling,
        "drift": drift,
        "lockstep": lockstep,
        "tuning": tuning,
        "hard_cases": hard_cases,
        "hard_cases-float32": hard_cases_float32,
        "sliders": sliders,
    }
    texts = {name: makers[name](own) for name, own in points.items() if own}
    if texts:
        rows = [[*map(str, row)] for row in targets(points, number)]
        head = ["figure", "measured", "quartiles", "required", "aim for"]
        texts = {"targets": table(head, rows), "machine": _machine(points), **texts}
    return texts


def filled(page: str, texts: dict[str, str]) -> str:
    """Returns the page with each text between its pair of markers."""
    for name, text in texts.items():
        begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
        between = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
        page = between.sub(lambda _, t=text, b=begin, e=end: f"{b}\n\n{t}\n\n{e}", page)
    return page
