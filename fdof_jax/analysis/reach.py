"""The reach of a tip: the curves that bound it, and the cells between them.

The edge of the reach consists of tips at which no joint that is free to move on can
move them across some line of the plane. Those lie on curves, one family for each choice
of the joints that stand at an end of their range. Every choice has a closed form:

- a free revolute joint moves the tip along a line's normal only if it is on the line;
- a free slide does so only if its link is parallel to the line.

So the tip and all free pivots are on one line, and the links before free slides are
parallel to it. Where the last link's direction is commanded, the tip is anywhere.
"""

from collections.abc import Iterator
from itertools import product
from typing import Any, NamedTuple, cast

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..base.checks import real_array
from ..base.known_values import in_numpy
from ..linkage.frames import known_frames
from ..linkage.linkage import Linkage, check_linkage, moving_joints
from ..linkage.topology import check_angles, letters

_SAMPLES, _CELLS, _ROUNDING = 361, 400, 1e-9
# Regions of fewer cells count as reached: random configurations may miss them.
_LEAST = 40


class Ranges(NamedTuple):
    """The joints of an arm, all in NumPy: kinds R, P or F, and ends of their ranges.

    The range of a revolute joint that can turn all the way round is (-pi, pi). The last
    link's direction is `orientation` [rad], or None if it is free.
    """

    linkage: Linkage
    kinds: str
    lower: np.ndarray
    upper: np.ndarray
    orientation: float | None

    @property
    def moving(self) -> list[int]:
        return moving_joints(self.linkage)

    def ends(self, k: int) -> tuple[float, ...]:
        whole = self.kinds[k] == "R" and self.upper[k] - self.lower[k] >= 2 * np.pi
        return () if whole else (self.lower[k], self.upper[k])

    def within(self, q: np.ndarray) -> np.ndarray:
        """Returns positions (..., n) with angles turned into their ranges, else NaN."""
        turns = np.array([kind == "R" for kind in self.kinds])
        ahead = q - self.lower + _ROUNDING
        q = np.where(turns, self.lower + ahead % (2 * np.pi) - _ROUNDING, q)
        beyond = (q < self.lower - _ROUNDING) | (q > self.upper + _ROUNDING)
        return np.where(beyond[..., self.moving].any(axis=-1, keepdims=True), np.nan, q)

    def tips(self, q: np.ndarray) -> np.ndarray:
        return known_frames(self.linkage, q).tip(self.linkage)


class _Body(NamedTuple):
    """The links that a free revolute joint, or none, carries up to the next one.

    Vectors x + iy are those where all free joints are at 0.
    """

    joint: int | None
    vector: complex  # from its pivot to the next, or to the tip
    slides: list[tuple[int, complex]]  # free slides in it, and directions before them

    @property
    def along(self) -> complex:
        """The vector that is parallel to the line."""
        return self.slides[0][1] if self.slides else self.vector


def ranges_of(
    linkage: Linkage, lower: ArrayLike, upper: ArrayLike, orientation: ArrayLike | None
) -> Ranges:
    """Returns the ranges of an arm's joints; raises ValueError for malformed ones."""
    check_linkage(linkage)
    name, ends = letters(linkage.ef), []
    kinds = np.array([*name])
    for argument, value in (("lower", lower), ("upper", upper)):
        end = real_array(
            argument, value, kinds.shape, finite=False, broadcast=True, unit="m or rad"
        )
        check_angles(argument, end, linkage.ef)
        for k in np.flatnonzero((kinds == "P") & ~np.isfinite(end)):
            raise ValueError(
                f"{argument}: expected a finite end of slide P{k + 1} [m], "
                f"got {end[k]}."
            )
        ends.append(np.asarray(end))
    low, high = ends
    if not (low < high)[kinds != "F"].all():
        raise ValueError(
            f"lower: expected less than upper, got {low.tolist()} and {high.tolist()}."
        )
    cases = [kinds == "F", (kinds == "R") & (high - low >= 2 * np.pi)]
    low, high = np.select(cases, [0, -np.pi], low), np.select(cases, [0, np.pi], high)
    if orientation is not None:
        orientation = float(real_array("orientation", orientation, (), unit="rad"))
        if "R" not in name:
            raise ValueError(
                f"orientation: expected None for slides only, got {orientation:g}."
            )
    return Ranges(in_numpy(linkage), name, low, high, orientation)


def curves(ranges: Ranges) -> Iterator[tuple[np.ndarray, bool]]:
    """Yields joint positions (samples, n) of each curve, and whether all are free.

    Positions out of range are NaN. If all joints are free, the arm is singular there.
    """
    moving, q = ranges.moving, np.zeros(len(ranges.kinds))
    for choice in product(*((None, *ranges.ends(k)) for k in moving)):
        free = [k for k, end in zip(moving, choice) if end is None]
        q[moving] = [0.0 if end is None else end for end in choice]
        for curve in _curves(ranges, q, free):
            curve = ranges.within(curve)
            if np.isfinite(curve).any():
                yield curve, free == moving


def _bodies(ranges: Ranges, q: np.ndarray, free: list[int]) -> tuple[list, float]:
    """The bodies from the ground to the tip, and the last link's direction [rad]."""
    start, direction, angle, *_ = known_frames(ranges.linkage, q)
    places = [*(start[k + 1] for k in free), ranges.tips(q)]
    bodies = [_Body(None, 0j, [])]
    for k, here, there in zip(free, places, places[1:]):
        if ranges.kinds[k] == "R":
            bodies.append(_Body(k, 0j, []))
        else:
            bodies[-1].slides.append((k, direction[k]))
        bodies[-1] = bodies[-1]._replace(vector=bodies[-1].vector + there - here)
    return bodies, angle[-1]


def _curves(ranges: Ranges, q: np.ndarray, free: list[int]) -> Iterator[np.ndarray]:
    bodies, direction = _bodies(ranges, q, free)
    turned = {0: 0.0}  # bodies whose angles are known
    if ranges.orientation is not None:
        if len(bodies) == 1:
            return
        turned[len(bodies) - 1] = ranges.orientation - direction
    sliding = [(g, *slide) for g in turned for slide in bodies[g].slides]
    between = [g for g in range(len(bodies)) if g not in turned]
    # Two slides that are not parallel move the tip anywhere; parallel ones are as one
    # that stands while the other moves to an end.
    if len(sliding) > 1 or any(len(bodies[g].slides) > 1 for g in between):
        return
    if not sliding and not between:
        return

    def at(moved: np.ndarray, sides: tuple[float, ...]) -> np.ndarray:
        """Positions where the one slide, or else the first joint, is at `moved`."""
        found = np.tile(q, (len(moved), 1))
        if sliding:
            g, k, along = sliding[0]
            found[:, k] = moved
            line = np.angle(along) + turned[g] + 0 * moved
        else:
            line = np.angle(bodies[1].along) + moved
        before, side = 0 * moved, iter(sides)
        for g, body in enumerate(bodies):
            if g in turned:
                angle = turned[g] + 0 * moved
            else:
                angle = line - np.angle(body.along) + next(side)
                if abs(body.along) < _ROUNDING:  # its joint does not move the tip
                    k = body.joint
                    angle = before + np.clip(0, ranges.lower[k], ranges.upper[k])
                for k, along in body.slides:
                    found[:, k] = -np.imag(body.vector * np.conj(along))
            if body.joint is not None:
                found[:, body.joint] = angle - before
            before = angle
        return found

    first = sliding[0][1] if sliding else bodies[1].joint
    low, high = ranges.lower[first], ranges.upper[first]
    for sides in product((0, np.pi), repeat=len(between)):
        if not sliding and sides[0]:
            continue  # the same line, run through the other way
        moved = np.linspace(low, high, _SAMPLES)
        if not sliding and ranges.orientation is not None:
            # The last joint turns back as the first one turns: where it meets its ends.
            last = bodies[-1].joint
            back = at(np.zeros(1), sides)[0, last] - np.array(ranges.ends(last))
            back = low + (back - low) % (2 * np.pi)
            moved = np.sort(np.append(moved, back[back < high]))
        yield at(moved, sides)


class Cells(NamedTuple):
    """Squares that cover the plane around the reach, and which of them are reached.

    The lower left corner is `low`, x + iy [m], and the squares have sides `step` [m].
    """

    low: complex
    step: float
    reached: np.ndarray  # (y, x)

    @property
    def corners(self) -> np.ndarray:
        height, width = self.reached.shape
        return self.low + np.array([0, self.step * complex(width, height)])

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away = (points - self.low) / self.step
        return away.imag.astype(int), away.real.astype(int)

    def on_edge(self, points: np.ndarray) -> np.ndarray:
        """Returns points beside cells that are not reached; others are NaN."""
        beside = scipy.ndimage.binary_dilation(~self.reached, np.ones((3, 3)))
        known = np.isfinite(points)
        edge = beside[self.at(np.where(known, points, self.low))]
        return np.where(known & edge, points, np.nan)


def reached_cells(ranges: Ranges, found: list[np.ndarray]) -> Cells:
    """Divides the plane around the reach into cells, and finds those that are reached.

    The curves divide the plane into regions, each of which is reached whole or not at
    all: the tip in some random configurations shows which.

    **Arguments:** `found`: joint positions of all curves.
    """
    paths = [ranges.tips(q) for q in found]
    points = np.concatenate(paths)
    points = points[np.isfinite(points)]
    x, y = np.real(points), np.imag(points)
    low = complex(x.min(), y.min())
    across = complex(x.max(), y.max()) - low
    step = (max(across.real, across.imag) or 1.0) / _CELLS
    # A margin of two cells is out of reach.
    shape = int(across.imag / step) + 5, int(across.real / step) + 5
    cells = Cells(low - 2 * step * (1 + 1j), step, np.zeros(shape, dtype=bool))

    walls = cells.reached
    for path in paths:
        longest = np.nanmax(np.abs(np.diff(path)), initial=0.0)
        parts = np.linspace(0, 1, 2 + int(2 * longest / step))
        between = path[:-1, None] + np.diff(path)[:, None] * parts
        walls[cells.at(between[np.isfinite(between)])] = True
    # Regions do not extend across corners, as walls may be diagonal.
    regions, count = cast(Any, scipy.ndimage.label(~walls))
    tips = ranges.tips(_configurations(ranges, found))
    # A cell beside a wall may be on both sides of the curve.
    inner = np.where(scipy.ndimage.binary_dilation(walls, np.ones((3, 3))), 0, regions)
    tried = np.bincount(inner[cells.at(tips[np.isfinite(tips)])], minlength=count + 1)
    inside = (tried > 0) | (np.bincount(inner.ravel(), minlength=count + 1) < _LEAST)
    inside[regions[0, 0]] = False
    return cells._replace(reached=walls | inside[regions])


def _configurations(ranges: Ranges, found: list[np.ndarray]) -> np.ndarray:
    """Random configurations: anywhere in the ranges, and beside the curves."""
    random, count = np.random.default_rng(0), 100_000
    span = ranges.upper - ranges.lower
    anywhere = ranges.lower + span * random.uniform(size=(count, len(span)))
    near = np.concatenate([q[:: _SAMPLES // 40] for q in found])
    near = random.choice(near[np.isfinite(near).all(axis=1)], count)
    away = 10 ** random.uniform(-4, -0.5, (count, 1))
    near = near + away * span * random.normal(size=near.shape)
    q = np.clip(np.concatenate([anywhere, near]), ranges.lower, ranges.upper)
    if ranges.orientation is not None:
        last = max(k for k in ranges.moving if ranges.kinds[k] == "R")
        q[:, last] = 0
        q[:, last] = ranges.orientation - known_frames(ranges.linkage, q).angle[:, -1]
    return ranges.within(q)
