"""The lines of a picture as sums over the links' frames, so that rows stay small.

The columns (time) are directions and starts of links, and further ones; a line (time,
corner) is their sum with coefficients (corner).
"""

from typing import NamedTuple

import numpy as np


class Line(NamedTuple):
    """A line of a part: its name and the coefficients (corner) of its columns."""

    name: str
    columns: dict[int, np.ndarray]


def lines_of(
    angle: np.ndarray, parts: dict[str, np.ndarray], small: float
) -> tuple[list[Line], list[np.ndarray]]:
    """Returns the lines of parts, and the further columns.

    `angle`: of links 0 to n (time, n + 1) [rad]; `small`: what nobody sees [m].
    """
    starts = [parts[f"link {k}"][:, 0] for k in range(1, angle.shape[1])]
    frames = np.column_stack([np.exp(1j * angle), *starts])
    lines, further = [], []
    for name, points in parts.items():
        there = ~np.isnan(points).all(axis=1)  # a payload is not, before it is taken
        drawn = ~np.isnan(points[there]).all(axis=0)  # else the pen is lifted
        known = points[there][:, drawn]
        shares, others = _split(frames[there], known, small)
        columns = dict(enumerate(shares))
        for values, share in others:
            column = np.full(len(points), np.nan, complex)
            column[there] = values
            columns[frames.shape[1] + len(further)] = share
            further.append(column)
        if not there.all() and not others:
            columns[frames.shape[1] + len(further)] = np.zeros_like(shares[0])
            further.append(np.where(there, 0, np.nan + 0j))
        corners = {}
        for place, share in columns.items():
            if place == 0 or place >= len(shares) or share.any():
                corners[place] = np.full(points.shape[1], np.nan, complex)
                corners[place][drawn] = share
        lines.append(Line(name, corners))
    return lines, further


def _split(
    frames: np.ndarray, points: np.ndarray, small: float
) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Returns coefficients of the frames, and further columns with theirs."""
    shares = np.linalg.lstsq(frames, points)[0]
    rest = points - frames @ shares
    weights = np.abs(frames).max(axis=0)[:, None] * np.abs(shares)
    shares = np.where(weights > small, shares, 0)
    if np.abs(rest).max(initial=0) < small:
        return shares, []
    left, sizes, right = np.linalg.svd(rest, full_matrices=False)
    return shares, [
        (left[:, k] * size, right[k]) for k, size in enumerate(sizes) if size > small
    ]
