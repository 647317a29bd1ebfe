"""Force elements in pictures: each is one line through the points of its symbol."""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.path import Path

from .. import Element, LinearActuator, Linkage, Point, SpringDamper, TipTask, Wrench
from ..forces import HardStops, JointStops, Payload, Tension, elements_on
from ..linkage import Frames
from ..references import Reference
from .axes import BLACK, Keywords, xy

# Widths are in sizes of the arm.
_WIDTH, _ARROW, _HEAD, _ARC = 0.025, 0.3, 0.05, 0.08
_BOX = _WIDTH * np.array([1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j, 1 + 1j])  # of a payload

COMMANDED: Keywords = dict(color=BLACK, lw=0.8, ls=(0, (5, 3)))
_THIN: Keywords = dict(color=BLACK, lw=0.8)
ELEMENT_STYLES: dict[str, Keywords] = {
    **dict.fromkeys(("spring", "damper", "bumper", "cable", "tension"), _THIN),
    "cylinder": dict(color=BLACK, lw=1.0),
    "wrench": dict(color=BLACK, lw=1.6, solid_joinstyle="miter"),
    "stops": dict(color=BLACK, lw=1.2),
    "payload": dict(color=BLACK, lw=1.6),
    "commanded": COMMANDED,
}


def element_lines(
    linkage: Linkage, forces: tuple, f: Frames, ts: np.ndarray, size: float
) -> dict[str, np.ndarray]:
    """Lines (time, points) of the elements that have a place, as x + iy [m].

    They are named by kind and index. `f`: the arm's frames; `size`: its extent [m].
    """
    given = elements_on(linkage, forces)
    for element in given:
        element.check(linkage, jnp.asarray(ts))
    acting = jax.device_get(given)
    pushes = {
        k: _push(element, linkage, f, ts)
        for k, element in enumerate(acting)
        if isinstance(element, Wrench)
    }
    most = [
        max(np.abs(part).max() for part in parts) for parts in zip(*pushes.values())
    ]
    lines = {}
    for k, element in enumerate(acting):
        kind, strokes, points = "", [], []
        if isinstance(element, SpringDamper | Tension | LinearActuator):
            kind, strokes = _between(element, f, size)
            points = [element.a, element.b]
        elif isinstance(element, Wrench):
            kind, points = "wrench", [element.point]
            strokes = _arrows(_place(element.point, f), *pushes[k], most, size)
        elif isinstance(element, Payload):
            there = np.broadcast_to(element.there(ts), ts.shape)
            box = _place(element.place, f) + _BOX * size
            # What is not taken at any of the times is not drawn.
            kind, strokes = "payload", [np.where(there[:, None], box, np.nan)]
            strokes = strokes if there.any() else []
        elif isinstance(element, JointStops | HardStops):
            kind, strokes = "stops", _stops(element, linkage, f, size)
        elif (path := _commanded(given[k])) is not None:
            kind, strokes = "commanded", [np.tile(path, (len(ts), 1))]
        if strokes:
            for point in points:
                strokes += _support(point, linkage, f, size)
            lift = np.full((len(ts), 1), np.nan + 0j)
            parts = [part for stroke in strokes for part in (stroke, lift)]
            lines[f"{kind} {k}"] = np.hstack(parts[:-1])
    return lines


def _commanded(element: Element) -> np.ndarray | None:
    """The path, once around, on which a controller leads the tip, or None."""
    share = jnp.linspace(0, 1, 201)
    is_reference = lambda part: isinstance(part, Reference)
    for part in jax.tree.leaves(element, is_leaf=is_reference):
        if isinstance(part, TipTask):
            return np.asarray(jax.vmap(part.path.point)(share)) @ [1, 1j]
        if is_reference(part) and part.tip is not None and part.period is not None:
            return np.asarray(jax.vmap(part.tip)(part.period * share)) @ [1, 1j]
    return None


def _place(point: Point, f: Frames) -> np.ndarray:
    """Places of a point (time, 1)."""
    offset = point.along + 1j * point.across
    return (f.start[:, point.link] + offset * f.direction[:, point.link])[:, None]


def _support(point: Point, arm: Linkage, f: Frames, size: float) -> list[np.ndarray]:
    """Lines of a support: hatched ground, or a bracket from the link."""
    place, link = _place(point, f), point.link
    if link == 0:
        hatches = [np.array([x, x - 0.7 - 0.9j]) for x in (-0.6, 0.4, 1.4)]
        strokes = [np.array([-1.4, 1.4]), *hatches]
        return [place + _WIDTH * size * stroke for stroke in strokes]
    low, high = sorted((0.0, float(arm.length[link])))
    along = np.clip(point.along, low, high)
    foot = (f.start[:, link] + along * f.direction[:, link])[:, None]
    away = np.abs(foot - place).max() > _WIDTH * size
    return [np.hstack([foot, place])] if away else []


# Symbols between (0, 0) and (1, 0); widths in units of `_WIDTH`.
_ZIGZAG = [
    np.array([0, *np.linspace(0.2, 0.8, 14), 1])
    + 1j * np.array([0, 0, *[1, -1] * 6, 0, 0])
]
_DASHPOT = [
    np.array([0, 0.35]),
    np.array([0.65 + 0.9j, 0.35 + 0.9j, 0.35 - 0.9j, 0.65 - 0.9j]),
    np.array([0.52 + 0.6j, 0.52 - 0.6j]),
    np.array([0.52, 1]),
]
_BAR = np.array([0.15 + 1.6j, 0.15 - 1.6j, 0.15, 0])
_BOTH = [_BAR, 1 - _BAR]  # join a spring and a damper side by side
for _symbol, _beside in ((_ZIGZAG, 1.6j), (_DASHPOT, -1.6j)):
    _BOTH += [0.15 + 0.7 * np.real(s) + 0.8j * np.imag(s) + _beside for s in _symbol]


# In the legend: a cable hangs, a tension is straight.
_HANGING = np.linspace(0, 1, 11)
_SYMBOLS = {
    "spring": _ZIGZAG,
    "damper": _DASHPOT,
    "bumper": [*_ZIGZAG, np.array([1 + 1.5j, 1 - 1.5j])],
    "cable": [_HANGING - 8j * _HANGING * (1 - _HANGING)],
    "tension": [np.array([0, 1])],
    "cylinder": [np.array([0.6, 0.6 + 1j, 1j, -1j, 0.6 - 1j, 0.6, 1])],
    "wrench": [np.array([0, 1, 0.7 + 1j, 1, 0.7 - 1j])],
    "payload": [0.5 + _BOX / _WIDTH / 3],
    "stops": [np.array([1.2j, -1.2j, 0, 1, 1 + 1.2j, 1 - 1.2j])],
    "commanded": [np.array([0, 0.4]), np.array([0.6, 1])],
}


def element_marker(kind: str) -> Path:
    """The symbol of a kind of element, for the legend."""
    strokes = _SYMBOLS[kind]
    points = np.concatenate([2 * np.real(s) - 1 + 0.25j * np.imag(s) for s in strokes])
    codes = [code for s in strokes for code in [1] + [2] * (len(s) - 1)]
    return Path(np.column_stack(xy(points)), codes)


def _between(
    element: SpringDamper | Tension | LinearActuator, f: Frames, size: float
) -> tuple[str, list[np.ndarray]]:
    """The symbol of an element between two points; a slack cable hangs."""
    a, b, width = _place(element.a, f), _place(element.b, f), _WIDTH * size
    length = np.abs(b - a)
    unit = (b - a) / np.where(length > 0, length, 1)
    if isinstance(element, Tension):
        return "tension", [np.hstack([a, b])]
    if isinstance(element, LinearActuator):  # of constant length, with a piston's rod
        body, half = min(0.95 * length.min(), 0.6 * length.mean()), 0.8j * width
        outline = np.array([0, half, body + half, body - half, -half, 0])
        return "cylinder", [a + unit * outline, np.hstack([a + unit * body, b])]
    rest = element.rest_length
    if element.side == 1:
        u = np.linspace(0, 1, 21)
        # The sag of a shallow parabola that is longer than its chord by the slack.
        sag = np.sqrt(0.375 * length * np.maximum(rest - length, 0))
        return "cable", [a + unit * length * u - 4j * sag * u * (1 - u)]
    symbol, kind = _ZIGZAG, "spring"
    if element.damping > 0:
        dry = element.stiffness == 0
        symbol, kind = (_DASHPOT, "damper") if dry else (_BOTH, "spring")
    if element.side == -1:  # as long as it is at rest, with a plate at its free end
        length, kind = np.minimum(length, rest), "bumper"
        symbol = [*symbol, np.array([1 + 1.5j, 1 - 1.5j])]
    place = lambda s: a + unit * (length * np.real(s) + 1j * width * np.imag(s))
    return kind, [place(s) for s in symbol]


def _push(
    element: Wrench, linkage: Linkage, f: Frames, ts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The force x + iy and the moment of a wrench (time, 1)."""
    force, moment = jax.vmap(lambda t: element.schedule(t, linkage))(ts)
    along = f.direction[:, element.point.link] if element.follows else 1
    return (np.asarray(force) * along)[:, None], np.asarray(moment)[:, None]


def _arrows(
    place: np.ndarray,
    force: np.ndarray,
    moment: np.ndarray,
    most: list[float],
    size: float,
) -> list[np.ndarray]:
    """A straight arrow for a force, and one around the point for a moment."""
    strokes = []
    if np.any(force):
        shaft = _ARROW * size * force / most[0]
        strokes += [place + shaft * np.array([0, 1]), _head(place + shaft, shaft, size)]
    if np.any(moment):
        sweep = 1.6 * np.pi * moment / most[1]
        spoke = _ARC * size * np.exp(1j * sweep * np.linspace(0, 1, 41))
        tip, along = spoke[:, -1:], 1j * spoke[:, -1:] * sweep
        strokes += [place + spoke, _head(place + tip, along, size)]
    return strokes


def _head(tip: np.ndarray, along: np.ndarray, size: float) -> np.ndarray:
    """The head of an arrow, smaller for a short one."""
    length = np.abs(along)
    back = along / np.where(length > 0, length, 1) * np.minimum(_HEAD * size, length)
    return tip - back * np.array([1 + 0.5j, 0, 1 - 0.5j])


def _stops(
    element: JointStops | HardStops, linkage: Linkage, f: Frames, size: float
) -> list[np.ndarray]:
    """Bars at the ends of each joint's range, joined by an arc around a pin."""
    kinds, radius, strokes = linkage.topology, 1.2 * _ARC * size, []
    for k, (kind, low, high) in enumerate(zip(kinds, element.lower, element.upper)):
        along, pin = f.direction[:, k : k + 1], f.start[:, k + 1 : k + 2]
        finite = [end for end in (low, high) if np.isfinite(end)]
        if kind == "R":
            bar = radius * np.array([0.8, 1.2])
            strokes += [pin + along * np.exp(1j * end) * bar for end in finite]
        if kind == "R" and len(finite) == 2:
            turns = np.linspace(low, min(high, low + 2 * np.pi), 41)
            strokes.append(pin + along * radius * np.exp(1j * turns))
        if kind == "P" and finite:  # bars across the rail, and the rail between them
            foot = f.start[:, k : k + 1] + along * float(linkage.length[k])
            bars = [1j * e + np.array([-2, 2, 0]) * _WIDTH * size for e in finite]
            strokes.append(foot + along * np.concatenate([bars[0], bars[-1][::-1]]))
    return strokes
