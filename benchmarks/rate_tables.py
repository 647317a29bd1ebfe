"""The tables of rates and times at errors that were reached."""

from collections.abc import Callable

import numpy as np

from .markdown import number, table
from .measure import TARGETS, times_at


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


def _by_solver(points: list[dict], to_value: Callable, sign: str) -> str:
    rows, measured = [], [p for p in points if p["status"] != "skipped"]
    for solver in dict.fromkeys(p["solver"] for p in measured):
        own = [p for p in points if p["solver"] == solver]
        first = max((p["compile_time"] or 0 for p in own), default=0)
        failed = [f"{p['setting']:g}" for p in own if p["status"] == "failed"]
        rows.append(
            [solver, *_read_off(own, to_value, sign), number(first), ", ".join(failed)]
        )
    errors = map("{:g}".format, TARGETS)
    text = table(["", *errors, "compile [s]", "failed at"], rows)
    skips = [p for p in points if p["status"] == "skipped"]
    return text + "".join(f"\n\nSkipped: {p['solver']}: {p['reason']}." for p in skips)


def batches(points: list[dict]) -> str:
    measured, parts = [p for p in points if p["status"] != "skipped"], []
    if not measured:
        return "Not measured: no GPU was at hand."
    for batch in dict.fromkeys(p["batch"] for p in measured):
        own = [p for p in measured if p["batch"] == batch]
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


def on_cores(points: dict[str, list[dict]]) -> str:
    """Returns the rates of a batch of 1024 on one core beside those on two."""
    jobs = {"one core": "batches", "two cores": "batches-two-cores"}
    rates: dict[str, list[str]] = {}
    for job in jobs.values():
        own = [p for p in points[job] if p["batch"] == 1024 and p["times"]]
        for solver in dict.fromkeys(p["solver"] for p in own):
            walls = [p for p in own if p["solver"] == solver]
            cells = _read_off(
                walls, lambda wall, p=walls[0]: p["simulated"] / wall, "≥"
            )
            rates.setdefault(solver, []).extend(cells[1:3])
    head = [f"{error:g}, {cores}" for cores in jobs for error in TARGETS[1:3]]
    rows = [[name, *cells] for name, cells in rates.items() if len(cells) == len(head)]
    return table(["", *head], rows)


def trajectory(points: list[dict]) -> str:
    parts = []
    for problem in dict.fromkeys(p["problem"] for p in points):
        own = [p for p in points if p["problem"] == problem]
        motions = next((p["motions"] for p in own if "motions" in p), 1)
        text = _by_solver(own, lambda wall, m=motions: 1e3 * wall / m, "≤")
        parts.append(f"{problem}, ms per motion at an error of:\n\n{text}")
    return "\n\n".join(parts)
