"""Accelerations and energies of an arm at many digits, independent of the library.

The paper's equations are not used. The mass centres' velocities are written as a
Jacobian of the joint rates, which gives M = sum m J^T J + I w w^T. The other terms come
from the centres' accelerations while the joints keep their rates. The conventions are
those of docs/conventions.md: link n = 2, 3, 4 starts at its characteristic point, with
A_n along it and B_n across it.
"""

import sys
from typing import Any, NamedTuple

import mpmath
from mpmath import mp

DIGITS = 50
EPS = sys.float_info.epsilon
# Roundings in the longest chain of operations from the inputs to an acceleration.
ROUNDINGS = 8


class Arm(NamedTuple):
    """A linkage as plain numbers, the form in which `fuzz` draws it."""

    topology: str
    length: Any  # A1..A4
    com: Any  # (p_n, q_n) of the three moving links
    mass: Any
    inertia: Any
    locked: Any
    base_angle: float
    gravity: float


class Acceleration(NamedTuple):
    """Joint accelerations, and data to judge a computation of them.

    - `qdd`: the accelerations (mpmath numbers), None if the mass matrix is singular.
    - `rho`: the pivots of the mass matrix, from the tip, over its diagonal: in [0, 1].
    - `matrix`: the mass matrix.
    - `inverse`: its inverse, as floats.
    - `levers`: square roots of the diagonal, with all lengths added as absolute values:
      the size of the terms of a sum that cancels.
    - `efforts`: the terms of efforts minus bias added as absolute values.
    - `angles`: the largest sum of absolute angles [rad].
    """

    qdd: tuple | None
    rho: tuple[float, float, float]
    matrix: list
    inverse: list
    levers: tuple[float, float, float]
    efforts: tuple[float, float, float]
    angles: float


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
    g = mp.mpf(arm.gravity)
    along = [mp.cos_sin(a) for a in angle]  # of links 1..4
    across = [(-s, c) for c, s in along]
    M = [[mp.mpf(0)] * 3 for _ in range(3)]
    bias, potential = [mp.mpf(0)] * 3, mp.mpf(0)
    starts, start_acceleration = [], (mp.mpf(0), mp.mpf(0))
    x, y = mp.mpf(0), mp.mpf(0)
    for n in range(3):  # moving link n + 2, whose joint pair stands on link n + 1
        (e, f), (u, v) = along[n], across[n]
        A, B, w = mp.mpf(arm.length[n]), slide[n], rate[n]
        x, y = x + A * e + B * u, y + A * f + B * v
        starts.append((x, y))
        # d2/dt2 (A e + B n) while the rates stay: e' = w n, n' = -w e.
        inward, aside = A * w**2 + 2 * slide_rate[n] * w, B * w**2
        ax, ay = start_acceleration
        start_acceleration = ax - inward * e - aside * u, ay - inward * f - aside * v
        (e, f), (u, v), w = along[n + 1], across[n + 1], rate[n + 1]
        p, q = map(mp.mpf, arm.com[n])
        rx, ry = p * e + q * u, p * f + q * v
        ax, ay = start_acceleration
        ax, ay = ax - w**2 * rx, ay - w**2 * ry + g
        m, inertia = mp.mpf(arm.mass[n]), mp.mpf(arm.inertia[n])
        potential += m * g * (y + ry)
        columns = []
        for k in range(n + 1):
            if arm.topology[k] == "R":
                sx, sy = starts[k]
                columns.append((-(y + ry - sy), x + rx - sx, 1))
            else:
                columns.append((*across[k], 0))
        for k, (jx, jy, turn) in enumerate(columns):
            bias[k] += m * (jx * ax + jy * ay)
            for i, (ix, iy, also) in enumerate(columns[: k + 1]):
                M[k][i] += m * (jx * ix + jy * iy) + inertia * turn * also
    for k in range(3):
        for i in range(k):
            M[i][k] = M[k][i]
    return M, bias, potential


def _factors(M):
    """Returns U^T D U by pivots from the tip, and their ratios to the diagonal."""
    D, L = [mp.mpf(0)] * 3, [[mp.mpf(0)] * 3 for _ in range(3)]
    rest = [row[:] for row in M]
    rho = [mp.mpf(0)] * 3
    for k in (2, 1, 0):
        D[k] = rest[k][k]
        # Only rounding at the working digits remains of an exactly singular matrix.
        if M[k][k] == 0 or D[k] <= M[k][k] * mp.mpf(10) ** (10 - mp.dps):
            return D, None, tuple(map(float, rho))
        rho[k] = D[k] / M[k][k]
        for i in range(k):
            L[k][i] = rest[k][i] / D[k]
        for i in range(k):
            for j in range(k):
                rest[i][j] -= L[k][i] * rest[k][j]
    return D, L, tuple(map(float, rho))


def _solve(D, L, f):
    y2 = f[1] - L[2][1] * f[2]
    y1 = f[0] - L[2][0] * f[2] - L[1][0] * y2
    x1 = y1 / D[0]
    x2 = y2 / D[1] - L[1][0] * x1
    return x1, x2, f[2] / D[2] - L[2][0] * x1 - L[2][1] * x2


def _sizes(arm: Arm, q, qd, tau, slide, slide_rate):
    """Returns `levers`, `efforts` and `angles` of an `Acceleration`, as floats."""
    turns = [joint == "R" for joint in arm.topology]
    rate = [0.0]
    for turn, velocity in zip(turns, qd):
        rate.append(rate[-1] + (abs(velocity) if turn else 0.0))
    levers, efforts = [0.0] * 3, [abs(t) for t in tau]
    reach, carried = [0.0] * 3, 0.0
    for n in range(3):
        A, B = abs(arm.length[n]), abs(float(slide[n]))
        for k in range(n):
            reach[k] += A + B
        carried += A * rate[n] ** 2 + 2 * abs(float(slide_rate[n])) * rate[n]
        carried += B * rate[n] ** 2
        radius = abs(arm.com[n][0]) + abs(arm.com[n][1])
        acceleration = carried + radius * rate[n + 1] ** 2 + abs(arm.gravity)
        for k in range(n + 1):
            lever = reach[k] + radius if turns[k] else 1.0
            own = arm.inertia[n] if turns[k] else 0.0
            levers[k] += arm.mass[n] * lever**2 + own
            efforts[k] += arm.mass[n] * lever * acceleration
    angles = abs(arm.base_angle)
    for turn, position, locked in zip(turns, q, arm.locked):
        angles += abs(position if turn else locked)
    return tuple(s**0.5 for s in levers), tuple(efforts), angles


def acceleration(arm: Arm, q, qd, tau, digits: int = DIGITS) -> Acceleration:
    """Returns joint accelerations under the joint efforts `tau`."""
    with mpmath.workdps(digits):
        return _acceleration(arm, q, qd, tau, *chain(arm, q, qd))


def acceleration_of_chain(arm: Arm, x, xd, tau, digits: int = DIGITS) -> Acceleration:
    """Returns joint accelerations at chain coordinates, whose angles are absolute."""
    with mpmath.workdps(digits):
        slide, angle = x[0::2], [arm.base_angle, *x[1::2]]
        slide_rate, rate = xd[0::2], [0, *xd[1::2]]
        q, qd = [], []
        for k, joint in enumerate(arm.topology):
            turns = joint == "R"
            q.append(float(angle[k + 1] - angle[k] if turns else slide[k]))
            qd.append(float(rate[k + 1] - rate[k] if turns else slide_rate[k]))
        exact = ([mp.mpf(a) for a in v] for v in (slide, slide_rate, angle, rate))
        return _acceleration(arm, q, qd, tau, *exact)


def _acceleration(arm, q, qd, tau, slide, slide_rate, angle, rate) -> Acceleration:
    M, bias, _ = equations(arm, slide, slide_rate, angle, rate)
    D, L, rho = _factors(M)
    sizes = _sizes(arm, q, qd, tau, slide, slide_rate)
    if L is None:
        return Acceleration(None, rho, M, [], *sizes)
    qdd = _solve(D, L, [mp.mpf(t) - b for t, b in zip(tau, bias)])
    units = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    inverse = [[float(x) for x in _solve(D, L, unit)] for unit in units]
    return Acceleration(qdd, rho, M, inverse, *sizes)


def energy(arm: Arm, q, qd, digits: int = 30):
    """Returns kinetic plus potential energy [J], an mpmath number."""
    with mpmath.workdps(digits):
        M, _, potential = equations(arm, *chain(arm, q, qd))
        kinetic = sum(M[i][j] * qd[i] * qd[j] for i in range(3) for j in range(3)) / 2
        return kinetic + potential
