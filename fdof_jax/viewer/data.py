"""Data of each motion for the page: rows as 32-bit numbers, lines, events."""

import base64
from typing import Any

import jax
import numpy as np

from .. import drawing, energy, joint_efforts
from ..forces import Payload, elements_on, present
from .lines import lines_of
from .motions import Motion

# What holds a joint, by the number in `Solution.modes`.
_HOLDERS = ["", "friction", "lower stop", "upper stop", "brake"]
_UNITS = {
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "effort": ("N m", "N"),
}


class Arrays:
    """Arrays of 32-bit numbers as texts, each once; `put` returns the place of one."""

    def __init__(self):
        self.places: dict[str, int] = {}

    def put(self, values: np.ndarray) -> int:
        """Complex numbers are put as pairs."""
        kind = np.complex64 if np.iscomplexobj(values) else np.float32
        little = np.ascontiguousarray(values, kind).view("<f4")
        text = base64.b64encode(little.tobytes()).decode()
        return self.places.setdefault(text, len(self.places))


def page_data(motions: list[Motion]) -> dict[str, Any]:
    """Returns all that the page shows, for JSON."""
    arrays = Arrays()
    shown = [_shown(motion, arrays) for motion in motions]
    return {"holders": _HOLDERS, "motions": shown, "arrays": [*arrays.places]}


def geometry(motion: Motion) -> Any:
    rows, solution = slice(motion.rows), motion.solution
    return drawing.geometry(
        motion.linkage, solution.q[rows], solution.ts[rows], motion.forces
    )


def box_of(parts: dict[str, np.ndarray]) -> list[float]:
    """Returns the bounds x, y below and above of all points [m]."""
    points = np.concatenate([part.ravel() for part in parts.values()])
    points = points[~np.isnan(points)]
    x, y = np.real(points), np.imag(points)
    return [float(end) for end in (x.min(), y.min(), x.max(), y.max())]


def _shown(motion: Motion, arrays: Arrays) -> dict[str, Any]:
    arm: Any = motion.linkage  # in NumPy
    solution, rows = motion.solution, slice(motion.rows)
    g, put = geometry(motion), arrays.put
    box = box_of(g.points)
    size = max(box[2] - box[0], box[3] - box[1], 1e-9)
    lines, further = lines_of(g.angle, g.points, 1e-5 * size)
    rounded = lambda share: np.round(share, 6 - int(np.floor(np.log10(size))))
    modes = [] if solution.modes is None else solution.modes[rows].T
    return {
        "title": motion.title,
        "kinds": arm.topology,
        "base": float(arm.base_angle),
        "length": arm.length.tolist(),
        "locked": arm.locked.tolist(),
        "box": box,
        "t": put(solution.ts[rows]),
        "q": [put(row) for row in solution.q[rows].T],
        "further": [put(column) for column in further],
        "lines": [
            [name, [[k, put(rounded(share))] for k, share in columns.items()]]
            for name, columns in lines
        ],
        "series": _series(motion, arrays),
        "modes": [put(row) for row in modes],
        "events": _events(motion),
        "ending": _ending(motion),
    }


def _series(motion: Motion, arrays: Arrays) -> list[dict[str, Any]]:
    """Returns the curves, each with its panel's name and unit, and its joint or -1."""
    arm, solution, rows = motion.linkage, motion.solution, slice(motion.rows)
    efforts = np.asarray(joint_efforts(arm, motion.forces, solution).total)
    series = []
    for name, values in zip(_UNITS, (solution.q, solution.qd, efforts)):
        if name == "effort" and not np.nan_to_num(efforts).any():
            continue  # a free motion
        for k, kind in enumerate(arm.topology):
            if kind != "F":
                unit = _UNITS[name][kind == "P"]
                curve = dict(panel=name, unit=unit, name=f"{kind}{k + 1}", joint=k)
                series.append(curve | {"y": arrays.put(values[rows, k])})
    kinetic, potential = _energies(motion)
    both = kinetic + potential
    for name, values in zip(
        ("kinetic", "potential", "total"), (kinetic, potential, both)
    ):
        curve = dict(panel="energy", unit="J", name=name, joint=-1)
        series.append(curve | {"y": arrays.put(values)})
    return series


def _energies(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Kinetic and potential energy of arm and elements (time,) [J]."""
    solution, rows = motion.solution, slice(motion.rows)
    # The control of a sampled motion is none of the elements.
    controls = int(solution.acting is not None)
    forces = elements_on(motion.linkage, motion.forces[controls:])

    of_row = lambda t, q, qd: energy(motion.linkage, q, qd, present(forces, t))
    energies = jax.vmap(of_row)(solution.ts, solution.q, solution.qd)
    kinetic, potential = (np.asarray(values)[rows] for values in energies)
    return kinetic, potential


def _events(motion: Motion) -> list[list[Any]]:
    """Returns events as time and words, in the order of time."""
    solution, last = motion.solution, motion.solution.ts[motion.rows - 1]
    found = []
    if solution.events is not None:
        table = solution.events.table
        for t, joint, word in zip(table["t [s]"], table["joint"], table["event"]):
            kind = motion.linkage.topology[joint - 1]
            name = f"{kind}{joint}" if joint else "the state"
            found.append((t, f"{name} {word}"))
    # The table has none of payloads, whose times are known.
    for load in motion.forces:
        if isinstance(load, Payload):
            for t, word in (load.begin, "picked up"), (load.end, "released"):
                if t is not None and solution.ts[0] < t <= last:
                    found.append((t, f"a payload is {word}"))
    found.sort(key=lambda event: event[0])
    if solution.end is not None and solution.ended:
        number = int(solution.end.condition)
        found.append((solution.end.t, f"condition {number} ends the motion"))
    return [[float(min(t, last)), text] for t, text in found]


def _ending(motion: Motion) -> str:
    """Says why a motion failed; "" if it did not."""
    outcome = str(motion.solution.outcome)
    if outcome in ("successful", "ended"):
        return ""
    return f"{outcome} at {motion.solution.ts[motion.rows - 1]:.4g} s"
