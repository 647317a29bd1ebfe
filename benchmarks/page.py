"""The tables of the results page, from the JSON lines."""

import re
from collections.abc import Callable

import numpy as np

from .held_joints import held_joints_table
from .joints import joints_table
from .memory import memory_table
from .scaling import slope
from .tables import (
    batches,
    hard_cases,
    hard_cases_float32,
    number,
    on_cores,
    switches_table,
    table,
    trajectory,
)
from .targets import targets


def _listed(points: list[dict], columns: list[tuple[str, str | Callable]]) -> str:
    """Returns a table with a row per point, of columns (head, key or function)."""
    rows = [
        [str(p[cell]) if isinstance(cell, str) else cell(p) for _, cell in columns]
        for p in points
    ]
    return table([head for head, _ in columns], rows)


def _number(key: str, digits: int = 2) -> Callable[[dict], str]:
    return lambda p: number(p.get(key), digits)


def _milliseconds(p: dict) -> str:
    return number(p["time_median"] and 1e3 * p["time_median"], 3)


def _quartiles(p: dict) -> str:
    return " to ".join(number(q, 3) for q in p["ratio_quartiles"] or [None, None])


_ratio = _number("ratio", 3)
_FAILED = "failed", lambda p: p["reason"] or ""

_COLUMNS: dict[str, list[tuple[str, str | Callable]]] = {
    "gradients": [
        ("parameters", "problem"),
        ("number", "parameters"),
        ("batch", "batch"),
        ("horizon [s]", lambda p: f"{p['horizon']:g}"),
        ("tolerance", _number("setting")),
        ("steps up to [s]", _number("longest_step")),
        ("mode", "gradient_mode"),
        ("ms", _milliseconds),
        ("over forward", _ratio),
        ("quartiles", _quartiles),
        ("gradient error", _number("error")),
        ("compile [s]", _number("compile_time")),
        _FAILED,
    ],
    "single_arms": [
        ("", "problem"),
        ("", "solver"),
        ("tolerance", _number("setting")),
        ("ms", _milliseconds),
        ("ratio", _ratio),
        ("quartiles", _quartiles),
        ("to", lambda p: p["ratio_to"] or ""),
        ("error", _number("error")),
        _FAILED,
    ],
    "compile_times": [
        ("", "problem"),
        ("", "solver"),
        ("of a process [s]", _number("time_median", 3)),
        ("of the first call [s]", _number("compile_time", 3)),
        (
            "second call [ms]",
            lambda p: number(1e3 * np.median(p["again"]) if p["times"] else None, 3),
        ),
        _FAILED,
    ],
    "drift": [
        ("", "solver"),
        ("setting", lambda p: f"{p['kind']} {p['setting']:g}" if p["setting"] else ""),
        ("s", _number("time_median", 3)),
        ("largest energy error [J]", _number("energy_defect")),
        _FAILED,
    ],
    "lockstep": [
        ("", "solver"),
        ("ms", _milliseconds),
        ("over clean", _ratio),
        ("quartiles", _quartiles),
        ("mean steps", _number("steps", 3)),
        ("most", _number("steps_max", 4)),
        ("most/mean", _number("waste")),
        _FAILED,
    ],
    "many": [
        ("scenes", "problem"),
        ("s", _number("time_median", 3)),
        ("mean steps", _number("steps", 3)),
        ("most", "steps_max"),
        ("successful", "successful"),
        ("off single motions by", _number("against_singles")),
        ("memory before [MB]", lambda p: f"{p['memory_before_mb']:.0f}"),
        ("at most [MB]", lambda p: f"{p['memory_peak_mb']:.0f}"),
        ("of it results [MB]", lambda p: f"{p['saved_mb']:.0f}"),
    ],
}


def generality(points: list[dict]) -> str:
    each = lambda p: number(1e9 * p["time_median"] / p["member_steps"], 3)
    columns = [("problem", "problem"), ("", "solver"), ("ns per member and step", each)]
    columns += [("ratio", _ratio), ("quartiles", _quartiles)]
    return _listed([p for p in points if p["times"]], columns)


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


def tuning(points: list[dict]) -> str:
    timed, robust, races = (
        [p for p in points if p["kind"] == kind] for kind in ("time", "robust", "race")
    )
    seconds = _listed(
        timed,
        [
            ("", "problem"),
            # An earlier row compiled what seems to take no time.
            (
                "compile [s]",
                lambda p: number(p["compile_time"]) if p["compile_time"] > 1 else "-",
            ),
            ("s", _number("time_median", 3)),
            ("s per start", lambda p: number(p["time_median"] / p["batch"], 3)),
            ("starts within 1 % of the best", lambda p: f"{100 * p['near']:.0f} %"),
        ],
    )
    *_, one, every = [p["time_median"] for p in timed]
    worst = [
        [p["problem"], p["solver"], *(number(v, 4) for v in p["worst"].values())]
        for p in robust
    ]
    limits = list(races[0]["best"]) if races else []
    raced = [
        [p["problem"], p["solver"], *(number(p["best"][limit], 4) for limit in limits)]
        for p in races
    ]
    return "\n\n".join(
        [
            seconds,
            f"Seven topologies with all their starts take {every / one:.0f} times as "
            "long as one with one start.",
            "Worst rms tip error [mm] over 64 members, of gains tuned for the nominal "
            "scene, for 16 other members, and, as a bound, for these 64 themselves:",
            table(["", "controller", "nominal", "robust", "bound"], worst),
            "Best rms tip error [mm] after so many seconds, median of the starts:",
            table(["", "optimiser", *(f"{limit} s" for limit in limits)], raced),
        ]
    )


def sliders(points: list[dict]) -> str:
    moves = [t for p in points if not p["problem"].startswith("between")
             for t in p["times"]]  # fmt: skip
    rows = []
    for p in [*points, {"problem": "all moves", "times": moves}]:
        if p["times"]:
            median, most = (number(1e3 * np.quantile(p["times"], q), 3)
                            for q in (0.5, 0.95))  # fmt: skip
            share = f"{100 * np.mean(np.array(p['times']) < 0.1):.1f} %"
            rows.append([p["problem"], str(len(p["times"])), median, most, share])
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


def tables(points: dict[str, list[dict]]) -> dict[str, str]:
    """Returns the text of each table that has been measured, by name."""
    makers = {
        "batches": batches,
        "mixed": batches,
        "trajectory": trajectory,
        "generality": generality,
        "checks": generality,
        "scaling": scaling,
        "joints": joints_table,
        "held_joints": held_joints_table,
        "memory": memory_table,
        "tuning": tuning,
        "hard_cases": hard_cases,
        "hard_cases-float32": hard_cases_float32,
        "sliders": sliders,
        "switches": switches_table,
    }
    texts = {}
    for name, own in points.items():
        if name in _COLUMNS:
            texts[name] = _listed(own, _COLUMNS[name])
        elif own:
            kind = name if name in makers else name.partition("-")[0]
            texts[name] = makers[kind](own)
    if points.get("batches") and points.get("batches-two-cores"):
        texts["batches-cores"] = on_cores(points)
    if texts:
        texts = {"targets": reached(points), "machine": _machine(points), **texts}
    return texts


def reached(*measured: dict[str, list[dict]]) -> str:
    """Returns the table of targets, each with the version of JAX that it is from."""
    head = ["figure", "measured", "quartiles", "required", "aim for", "JAX"]
    rows = [
        [*map(str, row), own[0]["versions"]["jax"]]
        for points in measured
        for name, own in points.items()
        for row in targets({name: own}, number)
    ]
    return table(head, rows)


def filled(page: str, texts: dict[str, str]) -> str:
    """Returns the page with each text between its pair of markers."""
    for name, text in texts.items():
        begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
        between = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
        page = between.sub(lambda _, t=text, b=begin, e=end: f"{b}\n\n{t}\n\n{e}", page)
    return page
