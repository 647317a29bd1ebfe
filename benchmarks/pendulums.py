"""Pendulums of any number of links in absolute angles, as one would write them by hand.

The equations are in scalars, with the elimination written out, so that NumPy, JAX and
heyoka's symbols take them. They share no line with the library: agreement is evidence.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

import fdof_jax as fj

from .measure import Skipped

_FEW = 3  # links whose angles are subtracted; with more, products take fewer sines


class Constants(NamedTuple):
    """Constants of a chain of turning joints, for its n links.

    - `step`: from each joint to the next, along and across the link (n - 1, 2) [m].
    - `first`, `second`: moments of each link about its joint, with the mass beyond at
      its end (n, 2) [kg m] and (n,) [kg m^2].
    """

    step: np.ndarray
    first: np.ndarray
    second: np.ndarray
    gravity: float
    base: float


def constants(linkage: fj.Linkage) -> Constants:
    if (np.asarray(linkage.ef)[1::2] < 0.5).any():
        raise Skipped("pendulums only")
    length, locked, com, mass, inertia = (
        np.asarray(a)
        for a in (linkage.length, linkage.locked, linkage.com, linkage.mass,
                  linkage.inertia)
    )  # fmt: skip
    step = np.stack([length[1:-1], locked[1:]], axis=1)
    beyond = np.append(np.cumsum(mass[::-1])[::-1][1:], 0)
    ends = np.append(step, np.zeros((1, 2)), axis=0)
    first = mass[:, None] * com + beyond[:, None] * ends
    second = inertia + mass * (com**2).sum(axis=1) + beyond * (ends**2).sum(axis=1)
    return Constants(
        step, first, second, float(linkage.gravity), float(linkage.base_angle)
    )


def accelerations(
    arm: Constants, angle: Sequence, rate: Sequence, sin: Callable, cos: Callable
) -> list[Any]:
    """Returns the angular accelerations of the links [rad/s^2]."""
    n, first, second = len(angle), arm.first.tolist(), arm.second.tolist()
    cosines, sines = [cos(a) for a in angle], [sin(a) for a in angle]
    squared = [w * w for w in rate]
    force: list[Any] = []
    for k, (along, across) in enumerate(first):
        weight = along * cosines[k]
        if across:
            weight = weight - across * sines[k]
        force.append(-arm.gravity * weight)
    coupling: list[dict[int, Any]] = [{} for _ in range(n)]
    for j in range(n):
        for i, (along, across) in enumerate(arm.step.tolist()[:j]):
            if n <= _FEW:
                c, s = cos(angle[j] - angle[i]), sin(angle[j] - angle[i])
            else:
                c = cosines[i] * cosines[j] + sines[i] * sines[j]
                s = cosines[i] * sines[j] - sines[i] * cosines[j]
            x, y = first[j]
            even, odd = along * x + across * y, across * x - along * y
            entry, slope = even * c, -even * s
            if odd:
                entry, slope = entry + odd * s, slope + odd * c
            coupling[j][i] = entry
            force[i] = force[i] - slope * squared[j]
            force[j] = force[j] + slope * squared[i]
    diagonal: list[Any] = list(second)
    factors = []
    for k in reversed(range(n)):
        column = coupling[k]
        factor = {i: column[i] / diagonal[k] for i in range(k)}
        for i in range(k):
            diagonal[i] = diagonal[i] - factor[i] * column[i]
            force[i] = force[i] - factor[i] * force[k]
            for j in range(i):
                coupling[i][j] = coupling[i][j] - factor[i] * column[j]
        factors.append(factor)
    found: list[Any] = []
    for k, factor in enumerate(reversed(factors)):
        value = force[k] / diagonal[k]
        for i in range(k):
            value = value - factor[i] * found[i]
        found.append(value)
    return found


def absolute(arm: Constants, q: Any, qd: Any) -> np.ndarray:
    """Returns angles and rates of the links, (..., 2n), of relative ones."""
    angle = np.cumsum(np.asarray(q), axis=-1) + arm.base
    return np.concatenate([angle, np.cumsum(np.asarray(qd), axis=-1)], axis=-1)


def relative(arm: Constants, y: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns joint positions and rates of `absolute` ones."""
    angle, rate = np.split(np.asarray(y), 2, axis=-1)
    q = np.diff(angle, axis=-1, prepend=arm.base)
    return q, np.diff(rate, axis=-1, prepend=0)
