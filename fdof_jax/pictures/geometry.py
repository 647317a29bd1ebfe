"""Positions of a linkage's parts during a motion, as pictures draw them."""

from typing import NamedTuple

import numpy as np

from ..linkage.frames import frames
from ..linkage.linkage import Linkage, check_linkage
from ..xla.array_namespace import in_numpy


class Geometry(NamedTuple):
    """A linkage at all samples; points of the plane are complex numbers.

    Link n runs from joint n - 1 along A_n to its `end`. The end of link 4 is the tip.
    """

    angle: np.ndarray  # th_1 to th_4 [rad]: (time, 4)
    slide: np.ndarray  # B_1 to B_3 [m]: (time, 3)
    revolute: np.ndarray  # whether each real joint is revolute: (3,)
    end: np.ndarray  # (time, 4)
    points: dict[str, np.ndarray]  # by name of the part, in drawing order: (time, n)


def geometry(linkage: Linkage, q: np.ndarray) -> Geometry:
    """The `Geometry` of a linkage at joint positions (time, 3)."""
    check_linkage(linkage)
    linkage = in_numpy(linkage)
    start, direction, angle, slide, revolute = frames(linkage, np.asarray(q))
    end = start + linkage.length * direction
    com = linkage.com
    foot = start[:, 1:] + com[:, 0] * direction[:, 1:]  # mass centre projected on A_n
    center = foot + 1j * com[:, 1] * direction[:, 1:]

    points = {}
    for n in range(4):
        link = [start[:, n], end[:, n]]
        if n < 3 and revolute[n]:
            link.append(start[:, n + 1])  # across by the fixed B_n
        elif n < 3:
            points[f"rail {n + 1}"] = np.column_stack([end[:, n], start[:, n + 1]])
        points[f"link {n + 1}"] = np.column_stack(link)
    for n in range(3):
        points[f"mass {n + 2}"] = np.column_stack([foot[:, n], center[:, n]])
    for n in range(3):
        kind = "pin" if revolute[n] else "slider"
        points[f"{kind} {n + 1}"] = start[:, n + 1 : n + 2]
    points["tip 4"] = end[:, 3:]
    return Geometry(angle, slide, revolute, end, points)
