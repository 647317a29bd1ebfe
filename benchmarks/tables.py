"""Tables in Markdown, from the JSON lines: rates, hard cases, switches."""

from collections.abc import Callable, Iterable

import numpy as np

from .measure import OUTCOMES, TARGETS, times_at


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


# Rates and times at errors that were reached


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


# Outcomes of the hard cases


def by_scene(points: list[dict]) -> dict[str, dict[int, str]]:
    """Returns, per engine, the worst outcome of each hard case that it can run."""
    worst: dict[str, dict[int, str]] = {}
    for point in points:
        if point["status"] != "skipped":
            own = worst.setdefault(point["solver"], {})
            both = [point["status"], own.get(point["number"], OUTCOMES[0])]
            own[point["number"]] = max(both, key=OUTCOMES.index)
    return worst


def hard_cases(points: list[dict]) -> str:
    worst = by_scene(points)
    numbers = {p["number"] for p in points}
    counts = [
        [engine, *(str(list(own.values()).count(o)) for o in OUTCOMES),
         str(len(numbers) - len(own))]
        for engine, own in worst.items()
    ]  # fmt: skip
    rows: dict[tuple, dict[str, str]] = {}
    bounds = {}
    for p in points:
        found = [p["status"]]
        if p["error"] is not None:
            found.append(f"error {number(p['error'])}")
        if p["steps"]:
            found.append(f"{p['steps']} steps")
        if p["time_median"]:
            found.append(f"{number(1e3 * p['time_median'])} ms")
        key = p["number"], p["problem"]
        rows.setdefault(key, {})[p["solver"]] = "; ".join(found)
        bounds.setdefault(key, number(p["bound"]))
    body = [
        [*map(str, key), bounds[key], *(own.get(engine, "-") for engine in worst)]
        for key, own in rows.items()
    ]
    return "\n\n".join(
        [
            table(["", *OUTCOMES, "not asked"], counts),
            table(["", "scene", "bound", *worst], body),
            _steps(points),
        ]
    )


def _steps(points: list[dict]) -> str:
    """Returns the steps of fdof_jax beside those of heyoka, where both move the arm."""
    found: dict[tuple, dict[str, dict]] = {}
    for p in points:
        found.setdefault((p["number"], p["problem"]), {})[p["solver"]] = p
    rows = []
    for (scene, name), by in found.items():
        both = [by.get(engine, {}) for engine in ("fdof_jax", "heyoka")]
        own, other = (point.get("steps") for point in both)
        if own and other:
            errors = [number(point["error"]) for point in both]
            if both[1]["status"] != OUTCOMES[0]:
                errors[1] = f"({errors[1]})"  # beyond the bound
            cells = f"{own}", f"{other}", f"{own / other:.2g}", *errors
            rows.append([str(scene), name, *cells])
    head = ["steps of fdof_jax", "of heyoka", "ratio", "error", "of heyoka"]
    return table(["", "scene", *head], rows)


def hard_cases_float32(points: list[dict]) -> str:
    rows: dict[tuple, list[str]] = {}
    tolerances = list(dict.fromkeys(p["setting"] for p in points))
    for p in points:
        found = p["reason"] if p["error"] is None else number(p["error"])
        if p["status"] not in (OUTCOMES[0], OUTCOMES[1]):
            found = f"({found})"
        rows.setdefault((p["number"], p["problem"], p["bound"]), []).append(found)
    body = [[str(n), name, number(b), *cells] for (n, name, b), cells in rows.items()]
    head = [f"at {tolerance:g}" for tolerance in tolerances]
    return table(["", "scene", "bound", *head], body)


# Errors of derivatives through switches


def switches_table(points: list[dict]) -> str:
    """Returns a row per scene and tolerance: the largest error and mean steps."""
    ways = list(dict.fromkeys(p["solver"] for p in points))
    rows: dict[tuple, dict[str, dict]] = {}
    for p in points:
        rows.setdefault((p["problem"], p["setting"]), {})[p["solver"]] = p
    body = []
    for (name, tolerance), by in rows.items():
        p = by[ways[0]]
        cells = [number(p[key]) for key in ("batch", "parameters", "switches")]
        for way in ways:
            known = by.get(way, {"error": None, "steps": None})
            cells += [number(known["error"]), number(known["steps"])]
        body.append([name, *cells, number(tolerance)])
    head = ["", "scenes", "parameters", "switches"]
    head += [cell for way in ways for cell in (way, "steps")]
    return table([*head, "tolerance"], body)
