"""The equations of one arm of known topology, in plain scalar arithmetic.

heyoka takes them as symbols, so no arrays are used. They are Kane's method, link by
link, and share no line with the library: agreement is evidence.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import fdof_jax as fj


class Drive(NamedTuple):
    """Joint efforts: effort + stiffness * (target - q) - damping * qd, all (3,)."""

    effort: Any = (0.0, 0.0, 0.0)
    stiffness: Any = (0.0, 0.0, 0.0)
    target: Any = (0.0, 0.0, 0.0)
    damping: Any = (0.0, 0.0, 0.0)


def make_rates(
    linkage: fj.Linkage,
    sin: Callable,
    cos: Callable,
    drive: Drive | None = None,
    control: Callable | None = None,
) -> Callable:
    """Returns a function from (q1, q2, q3, qd1, qd2, qd3) and the time to the rates.

    `control` returns three more joint efforts, from the time and the six numbers.
    """
    ef = np.asarray(linkage.ef)
    r1, r2, r3 = (bool(e) for e in ef[1::2] > 0.5)
    l1, l2, l3 = np.asarray(linkage.locked).tolist()
    _, a2, a3, _ = np.asarray(linkage.length).tolist()
    (x2, y2), (x3, y3), (x4, y4) = np.asarray(linkage.com).tolist()
    m2, m3, m4 = np.asarray(linkage.mass).tolist()
    i2, i3, i4 = np.asarray(linkage.inertia).tolist()
    base, g = float(linkage.base_angle), float(linkage.gravity)
    c1, s1 = float(np.cos(base)), float(np.sin(base))
    # A revolute joint turns (1) and does not slide (0), a prismatic one the reverse.
    t1, t2, t3 = float(r1), float(r2), float(r3)
    p1, p2, p3 = 1 - t1, 1 - t2, 1 - t3
    driven, controlled = drive is not None, control is not None
    (f1, f2, f3), (k1, k2, k3), (g1, g2, g3), (d1, d2, d3) = drive or Drive()

    def rates(
        q1: Any, q2: Any, q3: Any, u1: Any, u2: Any, u3: Any, t: Any = 0.0
    ) -> tuple:
        th2 = base + (q1 if r1 else l1)
        th3 = th2 + (q2 if r2 else l2)
        th4 = th3 + (q3 if r3 else l3)
        b2 = l2 if r2 else q2
        b3 = l3 if r3 else q3
        w2 = t1 * u1
        w3 = w2 + t2 * u2
        w4 = w3 + t3 * u3
        c2, c3, c4 = cos(th2), cos(th3), cos(th4)
        s2, s3, s4 = sin(th2), sin(th3), sin(th4)
        # From each link's start to the next link's (d) and to its mass centre (e).
        d2x, d2y = a2 * c2 - b2 * s2, a2 * s2 + b2 * c2
        d3x, d3y = a3 * c3 - b3 * s3, a3 * s3 + b3 * c3
        e2x, e2y = x2 * c2 - y2 * s2, x2 * s2 + y2 * c2
        e3x, e3y = x3 * c3 - y3 * s3, x3 * s3 + y3 * c3
        e4x, e4y = x4 * c4 - y4 * s4, x4 * s4 + y4 * c4
        # Velocity of mass centre n per unit rate of joint k.
        j21x, j21y = -p1 * s1 - t1 * e2y, p1 * c1 + t1 * e2x
        j31x, j31y = -p1 * s1 - t1 * (d2y + e3y), p1 * c1 + t1 * (d2x + e3x)
        j41x = -p1 * s1 - t1 * (d2y + d3y + e4y)
        j41y = p1 * c1 + t1 * (d2x + d3x + e4x)
        j32x, j32y = -p2 * s2 - t2 * e3y, p2 * c2 + t2 * e3x
        j42x, j42y = -p2 * s2 - t2 * (d3y + e4y), p2 * c2 + t2 * (d3x + e4x)
        j43x, j43y = -p3 * s3 - t3 * e4y, p3 * c3 + t3 * e4x
        # Accelerations of the mass centres while all joint rates stay, less gravity.
        v2, v3 = 2 * p2 * u2 * w2, 2 * p3 * u3 * w3
        z2x, z2y = -w2 * w2 * e2x, g - w2 * w2 * e2y
        f3x, f3y = -w2 * w2 * d2x - v2 * c2, g - w2 * w2 * d2y - v2 * s2
        z3x, z3y = f3x - w3 * w3 * e3x, f3y - w3 * w3 * e3y
        f4x, f4y = f3x - w3 * w3 * d3x - v3 * c3, f3y - w3 * w3 * d3y - v3 * s3
        z4x, z4y = f4x - w4 * w4 * e4x, f4y - w4 * w4 * e4y
        m11 = (
            m2 * (j21x * j21x + j21y * j21y)
            + m3 * (j31x * j31x + j31y * j31y)
            + m4 * (j41x * j41x + j41y * j41y)
            + t1 * (i2 + i3 + i4)
        )
        m12 = (
            m3 * (j31x * j32x + j31y * j32y)
            + m4 * (j41x * j42x + j41y * j42y)
            + t1 * t2 * (i3 + i4)
        )
        m22 = (
            m3 * (j32x * j32x + j32y * j32y)
            + m4 * (j42x * j42x + j42y * j42y)
            + t2 * (i3 + i4)
        )
        m13 = m4 * (j41x * j43x + j41y * j43y) + t1 * t3 * i4
        m23 = m4 * (j42x * j43x + j42y * j43y) + t2 * t3 * i4
        m33 = m4 * (j43x * j43x + j43y * j43y) + t3 * i4
        h1 = -(
            m2 * (j21x * z2x + j21y * z2y)
            + m3 * (j31x * z3x + j31y * z3y)
            + m4 * (j41x * z4x + j41y * z4y)
        )
        h2 = -(m3 * (j32x * z3x + j32y * z3y) + m4 * (j42x * z4x + j42y * z4y))
        h3 = -m4 * (j43x * z4x + j43y * z4y)
        if driven:
            h1 = h1 + f1 + k1 * (g1 - q1) - d1 * u1
            h2 = h2 + f2 + k2 * (g2 - q2) - d2 * u2
            h3 = h3 + f3 + k3 * (g3 - q3) - d3 * u3
        if controlled:
            c1st, c2nd, c3rd = control(t, q1, q2, q3, u1, u2, u3)
            h1, h2, h3 = h1 + c1st, h2 + c2nd, h3 + c3rd
        # Elimination from the last joint.
        n13, n23 = m13 / m33, m23 / m33
        n22, n12 = m22 - n23 * m23, m12 - n13 * m23
        k12 = n12 / n22
        r2nd = h2 - n23 * h3
        acc1 = (h1 - n13 * h3 - k12 * r2nd) / (m11 - n13 * m13 - k12 * n12)
        acc2 = r2nd / n22 - k12 * acc1
        return u1, u2, u3, acc1, acc2, h3 / m33 - n13 * acc1 - n23 * acc2

    return rates
