"""Accelerations and energies of an arm at many digits, independent of the library.

M = sum m J^T J + I w w^T, with the mass centres' velocities J qd; the other terms come
from the centres' accelerations while the joints keep their rates. Each moving link
starts at its characteristic point, with A_n along the link before and B_n across it.
"""

import sys
from typing import Any, NamedTuple

import mpmath
import numpy as np
from mpmath import mp

DIGITS = 50
EPS = sys.float_info.epsilon
# Roundings in the longest chain of operations from the inputs to an acceleration.
ROUNDINGS = 8


class Arm(NamedTuple):
    """A linkage as plain numbers."""

    topology: str
    length: Any  # A1..A4
    com: Any  # (p_n, q_n) of the moving links
    mass: Any
    inertia: Any
    locked: Any
    base_angle: float
    gravity: float


class Acceleration(NamedTuple):
    """Joint accelerations, and data to judge a computation of them.

    - `qdd`: the accelerations (mpmath numbers), None if the mass matrix is singular.
    - `matrix`: the mass matrix.
    - `inverse`: its inverse, as floats.
    - `levers`: square roots of the diagonal, with all lengths added as absolute values:
      the size of the terms of a sum that cancels.
    - `efforts`: the terms of efforts minus bias added as absolute values.
    - `angles`: the largest sum of absolute angles [rad].
    """

    qdd: tuple | None
    matrix: Any
    inverse: np.ndarray
    levers: np.ndarray
    efforts: np.ndarray
    angles: float


def floats(values):
    return np.array([float(x) for x in values])


def chain(arm: Arm, q, qd):
    """Returns slides and absolute angles of the pairs, and rates, unrounded."""
    slide, slide_rate, angle, rate = [], [], [mp.mpf(arm.base_angle)], [mp.mpf(0)]
    for joint, position, velocity, locked in zip(arm.topology, q, qd, arm.locked):
        turns = joint == "R"
        slide.append(mp.mpf(locked if turns else position))
        slide_rate.append(mp.mpf(0 if turns else velocity))
        angle.append(angle[-1] + mp.mpf(position if turns else locked))
        rate.append(rate[-1] + mp.mpf(velocity if turns else 0))
    return slide, slide_rate, angle, rate


def equations(arm: Arm, slide, slide_rate, angle, rate):
    """Returns mass matrix, bias (velocity terms, gravity) and potential energy."""
    count = len(arm.topology)
    M, bias, potential = mp.zeros(count), mp.zeros(count, 1), mp.mpf(0)
    along = [mp.cos_sin(a) for a in angle]
    across = [(-s, c) for c, s in along]
    starts = []
    x, y, start_ax, start_ay = (mp.mpf(0),) * 4
    for n in range(count):  # the link behind joint pair n
        (e, f), (u, v), w = along[n], across[n], rate[n]
        A, B = mp.mpf(arm.length[n]), slide[n]
        x, y = x + A * e + B * u, y + A * f + B * v
        starts.append((x, y))
        # d2/dt2 (A e + B n) while the rates stay: e' = w n, n' = -w e.
        inward, aside = A * w**2 + 2 * slide_rate[n] * w, B * w**2
        start_ax -= inward * e + aside * u
        start_ay -= inward * f + aside * v
        (e, f), (u, v), w = along[n + 1], across[n + 1], rate[n + 1]
        p, q = map(mp.mpf, arm.com[n])
        rx, ry = p * e + q * u, p * f + q * v
        ax, ay = start_ax - w**2 * rx, start_ay - w**2 * ry + mp.mpf(arm.gravity)
        m, inertia = mp.mpf(arm.mass[n]), mp.mpf(arm.inertia[n])
        potential += m * mp.mpf(arm.gravity) * (y + ry)
        columns = [
            (sy - y - ry, x + rx - sx, 1) if joint == "R" else (*axis, 0)
            for joint, (sx, sy), axis in zip(arm.topology, starts, across)
        ]
        for k, (jx, jy, turn) in enumerate(columns):
            bias[k] += m * (jx * ax + jy * ay)
            for i, (ix, iy, also) in enumerate(columns):
                M[k, i] += m * (jx * ix + jy * iy) + inertia * turn * also
    return M, bias, potential


def _sizes(arm: Arm, q, qd, tau, slide, slide_rate):
    """Returns `levers`, `efforts` and `angles` of an `Acceleration`."""
    turns = np.array([joint == "R" for joint in arm.topology])
    rate = np.cumsum([0, *np.where(turns, np.abs(qd), 0)])
    A, B = np.abs(arm.length[: len(turns)]), np.abs(floats(slide))
    slide_rate, radius = np.abs(floats(slide_rate)), np.abs(arm.com).sum(axis=1)
    carried = (A + B) * rate[:-1] ** 2 + 2 * slide_rate * rate[:-1]
    acceleration = np.cumsum(carried) + radius * rate[1:] ** 2 + abs(arm.gravity)
    # Of joints, down, and of the links beyond, across.
    beyond = np.triu(np.tile(A + B, (len(turns), 1)), 1)
    lever = np.where(turns[:, None], np.cumsum(beyond, axis=1) + radius, 1.0)
    own = turns[:, None] * np.array(arm.inertia)
    levers = np.triu(arm.mass * lever**2 + own).sum(axis=1)
    efforts = np.abs(tau) + np.triu(arm.mass * lever * acceleration).sum(axis=1)
    angles = abs(arm.base_angle) + np.abs(np.where(turns, q, arm.locked)).sum()
    return np.sqrt(levers), efforts, angles


def acceleration(arm: Arm, q, qd, tau, digits: int = DIGITS) -> Acceleration:
    """Returns joint accelerations under the joint efforts `tau`."""
    with mpmath.workdps(digits):
        return _acceleration(arm, q, qd, tau, *chain(arm, q, qd))


def acceleration_of_chain(arm: Arm, x, xd, tau, digits: int = DIGITS) -> Acceleration:
    """Returns joint accelerations at chain coordinates, whose angles are absolute."""
    turns = [joint == "R" for joint in arm.topology]
    angle, rate = [arm.base_angle, *x[1::2]], [0, *xd[1::2]]
    q = np.where(turns, np.diff(angle), x[0::2]).tolist()
    qd = np.where(turns, np.diff(rate), xd[0::2]).tolist()
    with mpmath.workdps(digits):
        exact = [[*map(mp.mpf, v)] for v in (x[0::2], xd[0::2], angle, rate)]
        return _acceleration(arm, q, qd, tau, *exact)


def _acceleration(arm, q, qd, tau, slide, slide_rate, angle, rate) -> Acceleration:
    M, bias, _ = equations(arm, slide, slide_rate, angle, rate)
    sizes = _sizes(arm, q, qd, tau, slide, slide_rate)
    # Of pivots from the tip, only rounding remains where M is exactly singular.
    minors = [*(mp.det(M[k:, k:]) for k in range(M.rows)), mp.mpf(1)]
    least = mp.mpf(10) ** (10 - mp.dps)
    if any(
        a <= b * M[k, k] * least for k, (a, b) in enumerate(zip(minors, minors[1:]))
    ):
        return Acceleration(None, M, np.zeros(0), *sizes)
    inverse = mp.inverse(M)
    qdd = inverse * (mp.matrix([mp.mpf(t) for t in tau]) - bias)
    return Acceleration(tuple(qdd), M, floats(inverse).reshape(M.rows, -1), *sizes)


def energy(arm: Arm, q, qd, digits: int = 30):
    """Returns kinetic plus potential energy [J], an mpmath number."""
    with mpmath.workdps(digits):
        M, _, potential = equations(arm, *chain(arm, q, qd))
        rates = mp.matrix([mp.mpf(v) for v in qd])
        return (rates.T * M * rates)[0] / 2 + potential
