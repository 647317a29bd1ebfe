"""Plots of the results, with the error along x and the cost along y."""

from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter

from .joints import compile_time, speed, step_time
from .measure import OUTCOMES, times_at

# Okabe and Ito's colours suit all colour vision; markers differ as well.
COLORS = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#D55E00", "#0072B2", "#CC79A7",
          "#999999")  # fmt: skip
MARKERS = "osD^v<>PX*ph"
WIDTH = 6.3  # of a text column [inch]


# In this order, so that a solver looks the same in all plots.
ORDER = (
    "fdof_jax", "fdof_jax sweep", "plain diffrax", "heyoka", "MuJoCo RK4", "C order 8",
    "C RK4", "fdof_jax Tsit5", "fdof_jax Dopri8", "SciPy DOP853", "SciPy LSODA",
    "MJX RK4", "MuJoCo Euler", "MuJoCo implicitfast", "fdof_jax Kvaerno5",
    "plain diffrax, masked 6x6",
)  # fmt: skip


def _style(solver: str, index: int) -> dict:
    plain = solver.split(", numba")[0].split(", reduced")[0].split(", fixed")[0]
    if plain in ORDER:
        index = ORDER.index(plain)
    return {
        "color": COLORS[index % len(COLORS)],
        "marker": MARKERS[index % len(MARKERS)],
        "linestyle": "--" if "fixed" in solver else "-",
        "linewidth": 1.8 if solver.startswith("fdof_jax") else 1.0,
        "markersize": 4,
    }


def _solvers(points: list[dict]) -> list[str]:
    return list(dict.fromkeys(p["solver"] for p in points if p["status"] != "skipped"))


def _axes(panels: int, height: float = 3.4):
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(1, panels, squeeze=False)[0]


def _save(figure, path: Path) -> None:
    """Saves a figure, with one legend below all panels."""
    entries = {}
    for axis in figure.axes:
        for handle, label in zip(*axis.get_legend_handles_labels()):
            entries.setdefault(label, handle)
    if entries:
        figure.legend(
            entries.values(), entries, loc="outside lower center", ncols=3, fontsize=7,
            handlelength=3.5,  # shows dashes
        )  # fmt: skip
    figure.savefig(path, dpi=160)


def _curves(axis, points: list[dict], height: Callable[[dict], float]) -> None:
    """Draws a line per solver, and a cross at the bottom for each failed run."""
    for index, solver in enumerate(_solvers(points)):
        own = [p for p in points if p["solver"] == solver]
        good = [p for p in own if p["times"] and p["error"]]
        failed = [p["error"] for p in own if p["status"] == "failed"]
        name = solver.split(", numba")[0].split(", reduced")[0]
        label = name + (f" ({len(failed)} failed)" if not good else "")
        good.sort(key=lambda p: p["error"])
        axis.loglog(
            [p["error"] for p in good],
            [height(p) for p in good],
            label=label,
            **_style(solver, index),
        )
        axis.plot(
            [min(error or 1.0, 1.0) for error in failed],
            [0.02 + 0.03 * (index % 5)] * len(failed),
            "x",
            color=_style(solver, index)["color"],
            transform=axis.get_xaxis_transform(),
        )
    axis.invert_xaxis()
    axis.grid(alpha=0.3)
    axis.xaxis.set_minor_formatter(NullFormatter())


def trajectory(points: list[dict], path: Path) -> None:
    titles = {"fig5-error-to-2s": "Fig 5, 10 s", "random": "random arms, 2 s"}
    figure, axes = _axes(2, height=4.4)
    for axis, (problem, title) in zip(axes, titles.items()):
        own = [p for p in points if p["problem"] == problem]
        _curves(axis, own, lambda p: 1e3 * p["time_median"] / p["motions"])
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("largest joint error [rad or m]")
    axes[0].set_xlabel("largest joint error up to 2 s [rad]")
    axes[0].set_ylabel("time per motion [ms]")
    _save(figure, path)


def batches(points: list[dict], path: Path) -> None:
    """Draws throughput against error at one size, and against size at one error."""
    sizes = sorted({p["batch"] for p in points if p["status"] != "skipped"})
    size = 1024 if 1024 in sizes else sizes[-1]
    own = [p for p in points if p["batch"] == size]
    rates = {solver: _rates(points, solver, sizes) for solver in _solvers(own)}
    several = np.isfinite(list(rates.values())).sum(axis=1).max() > 1
    figure, (left, *others) = _axes(2 if several else 1, height=4.2)
    _curves(left, own, lambda p: p["simulated"] / p["time_median"])
    left.set_title(f"batch of {size}", fontsize=9)
    left.set_xlabel("worst member's error [rad]")
    left.set_ylabel("simulated s per s")
    for right in others:
        for index, (solver, heights) in enumerate(rates.items()):
            right.loglog(sizes, heights, **_style(solver, index))
        right.set_title("at a worst error of 1e-6", fontsize=9)
        right.set_xlabel("batch")
        right.grid(alpha=0.3)
    _save(figure, path)


def _rates(points: list[dict], solver: str, sizes: list[int]) -> list[float]:
    """Returns throughput at a worst error of 1e-6 for each size; NaN if not reached."""
    found = []
    for batch in sizes:
        mine = [p for p in points if p["solver"] == solver and p["batch"] == batch]
        walls = times_at(mine, 1e-6)
        found.append(
            np.nan if walls is None else mine[0]["simulated"] / np.median(walls)
        )
    return found


def memory(points: list[dict], path: Path) -> None:
    """Draws peak memory and time against the number of members."""
    figure, axes = _axes(2)
    labels = {"memory_peak_mb": "largest memory [MB]", "time_median": "time [s]"}
    for axis, (key, label) in zip(axes, labels.items()):
        for index, kind in enumerate(_solvers(points)):
            own = [p for p in points if p["solver"] == kind and p["times"]]
            sizes, heights = [p["batch"] for p in own], [p[key] for p in own]
            axis.loglog(sizes, heights, label=kind, **_style(kind, index))
        axis.set_xlabel("members")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    _save(figure, path)


def joints(points: list[dict], path: Path) -> None:
    """Draws times and operations against the number of joints."""
    points = [p for p in points if p["status"] != "skipped"]
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True).ravel()
    quantities = {
        "time per simulated s at 1e-8 [µs]": lambda own: 1e6 / (speed(own) or np.nan),
        "time per step of a member [µs]": lambda own: 1e6 * (step_time(own) or np.nan),
        "time to compile [s]": lambda own: compile_time(own) or np.nan,
        "operations of the equations [flop]": lambda own: own[0]["flops"],
    }
    curves = [(p["solver"], p["batch"]) for p in points]
    for axis, (label, quantity) in zip(axes, quantities.items()):
        for solver, batch in dict.fromkeys(curves):
            if "compile" in label and solver.startswith("MuJoCo"):
                continue  # nothing is compiled
            if "flop" in label and (batch > 1 or solver != "fdof_jax"):
                continue  # the same in a batch; others are not counted
            by_number = {}
            for point in points:
                if (point["solver"], point["batch"]) == (solver, batch):
                    by_number.setdefault(point["joints"], []).append(point)
            heights = [quantity(own) for own in by_number.values()]
            style = _style(solver, 0) | ({"linestyle": "--"} if batch == 1 else {})
            name = solver + (", one chain" if batch == 1 else f", batch of {batch}")
            axis.plot(list(by_number), heights, label=name, **style)
        axis.set_yscale("linear" if "flop" in label else "log")
        axis.set_ylabel(label, fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
    for axis in axes[2:]:
        axis.set_xlabel("joints", fontsize=8)
    _save(figure, path)


def generality(points: list[dict], path: Path) -> None:
    figure, (axis,) = _axes(1, height=2.4)
    own = [p for p in points if p["problem"] == "RRR-rk4" and p["times"]]
    names = [p["solver"] for p in own]
    nanoseconds = [1e9 * p["time_median"] / p["member_steps"] for p in own]
    bars = axis.barh(names, nanoseconds, color=COLORS[5])
    axis.bar_label(bars, fmt="%.0f", fontsize=7, padding=2)
    axis.set_xscale("log")
    axis.margins(x=0.15)
    axis.invert_yaxis()
    axis.tick_params(labelsize=7)
    axis.set_xlabel("one RK4 step of one member [ns]")
    _save(figure, path)


def gradients(points: list[dict], path: Path) -> None:
    """Draws the error of six gains' gradient against its cost, along tolerances."""
    figure, axes = _axes(2)
    for axis, problem in zip(axes, ("gains", "gains, limited")):
        own = [
            p
            for p in points
            if p["problem"] == problem
            and (p["batch"], p["horizon"]) == (1, 4.0)
            and p["gradient_mode"] != "none"
        ]
        _curves(axis, own, lambda p: 1e3 * p["time_median"])
        axis.set_title(problem.replace("limited", "with limited efforts"), fontsize=9)
        axis.set_xlabel("gradient error, relative to its norm")
    axes[0].set_ylabel("value and gradient [ms]")
    _save(figure, path)


def drift(points: list[dict], path: Path) -> None:
    figure, (axis,) = _axes(1)
    _curves(axis, points, lambda p: p["time_median"])
    axis.set_xlabel("largest energy error [J]")
    axis.set_ylabel("time [s]")
    axis.set_title(next((p["problem"] for p in points if p["problem"]), ""), fontsize=9)
    _save(figure, path)


def hard_cases(points: list[dict], path: Path) -> None:
    """Draws a cell per scene and engine: its outcome, and error over bound."""
    rows = list(dict.fromkeys((p["number"], p["problem"]) for p in points))
    engines = _solvers(points)
    colors = dict(zip(OUTCOMES, (COLORS[3], COLORS[2], COLORS[1], COLORS[4])))
    figure = Figure(figsize=(WIDTH, 0.17 * len(rows) + 1), layout="constrained")
    axis = figure.subplots()
    for p in points:
        if p["status"] not in OUTCOMES:
            continue
        x, y = engines.index(p["solver"]), rows.index((p["number"], p["problem"]))
        axis.barh(y, 0.96, left=x - 0.48, height=0.9, color=colors[p["status"]])
        text = p["status"] if p["status"] != OUTCOMES[0] else ""
        if p["error"] is not None and p["bound"]:
            text = f"{p['error'] / p['bound']:.0e} of bound"
        axis.text(x, y, text, ha="center", va="center", fontsize=6)
    axis.set_xticks(range(len(engines)), engines, fontsize=8)
    axis.set_yticks(range(len(rows)), [f"{n}  {name}" for n, name in rows], fontsize=6)
    axis.xaxis.tick_top()
    axis.set_xlim(-0.5, len(engines) - 0.5)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    handles = [Patch(color=color, label=name) for name, color in colors.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=7)
    figure.savefig(path, dpi=160)


PLOTS = {
    "trajectory": trajectory,
    "batches": batches,
    "batches-two-cores": batches,
    "batches-float32": batches,
    "batches-gpu": batches,
    "batches-gpu-float32": batches,
    "mixed": batches,
    "memory": memory,
    "joints": joints,
    "generality": generality,
    "gradients": gradients,
    "drift": drift,
    "hard_cases": hard_cases,
}


def draw(points: dict[str, list[dict]], folder: Path) -> None:
    """Draws a PNG for each measured job that has a plot."""
    matplotlib.rcParams["font.size"] = 8
    for name, plot in PLOTS.items():
        own = points.get(name, [])
        if any(p["times"] for p in own):
            plot(own, folder / f"{name}.png")
