"""Positions of a linkage's parts during a motion, as pictures draw them."""

from typing import NamedTuple

import numpy as np

from ..linkage.frames import frames
from ..linkage.linkage import Linkage, check_linkage
from ..xla.array_namespace import in_numpy


class Geometry(NamedTuple):
    """A linkage at all samples; points of the plane are complex numbers.

    Link 0 is the ground, and links 1 to 3 move; joint k is between links k - 1 and k.
    """

    angle: np.ndarray  # absolute angles of links 0 to 3 [rad]: (time, 4)
    slide: np.ndarray  # B_1 to B_3 [m]: (time, 3)
    revolute: np.ndarray  # whether each real joint is revolute: (3,)
    points: dict[str, np.ndarray]  # by name of the part, in drawing order: (time, n)

    @property
    def tip(self) -> np.ndarray:
        return self.points["tip 3"][:, 0]

    @property
    def all_points(self) -> np.ndarray:
        return np.hstack(list(self.points.values()))


def geometry(linkage: Linkage, q: np.ndarray) -> Geometry:
    """The `Geometry` of a linkage at joint positions (time, 3)."""
    check_linkage(linkage)
    linkage = in_numpy(linkage)
    start, direction, angle, slide, revolute = frames(linkage, np.asarray(q))
    end = start + linkage.length * direction
    along, across = linkage.com.T
    foot = start[:, 1:] + along * direction[:, 1:]  # mass centre projected on the link
    center = foot + 1j * across * direction[:, 1:]

    points = {}
    for n in range(4):
        link = [start[:, n], end[:, n]]
        if n < 3 and revolute[n]:
            link.append(start[:, n + 1])  # across by the fixed B
        elif n < 3:
            points[f"rail {n + 1}"] = np.column_stack([end[:, n], start[:, n + 1]])
        points[f"link {n}"] = np.column_stack(link)
    for n in range(3):
        points[f"mass {n + 1}"] = np.column_stack([foot[:, n], center[:, n]])
    for n in range(3):
        kind = "pin" if revolute[n] else "slider"
        points[f"{kind} {n + 1}"] = start[:, n + 1 : n + 2]
    points["tip 3"] = end[:, 3:]
    return Geometry(angle, slide, revolute, points)
