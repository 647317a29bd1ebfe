"""The outcomes of the hard cases as tables."""

from .markdown import number, table
from .measure import OUTCOMES


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
