"""Fig 7's controller in plain scalar arithmetic, for engines without JAX.

Like `chain` it shares no line with the library.
"""

import math
from collections.abc import Callable

import numpy as np

from .measure import Skipped
from .problems import Problem


def make_reference(problem: Problem, compiled: Callable = lambda f: f) -> Callable:
    """Returns a function from the time to an RPR arm's positions and velocities."""
    linkage, (controller,) = problem.linkage, problem.forces
    if problem.topology != "RPR":
        raise Skipped("a controller of another arm than Fig 7's")
    task = controller.reference
    cx, cy = (float(x) for x in task.center)
    radius, period, phase = (float(x) for x in (task.radius, task.period, task.phase))
    th4, branch = float(task.orientation), float(task.branch)
    base = float(linkage.base_angle)
    a1, a2, a3, a4 = (float(x) for x in linkage.length)
    l1, l2, l3 = (float(x) for x in linkage.locked)
    # From the first joint to the circle's centre, less the last link.
    hx = cx - a1 * math.cos(base) + l1 * math.sin(base) - a4 * math.cos(th4)
    hy = cy - a1 * math.sin(base) - l1 * math.cos(base) - a4 * math.sin(th4)
    bearing = math.atan2(hy, hx)
    # Seen from link 2, the wrist moves on a line at this distance.
    along = a2 + a3 * math.cos(l2) - l3 * math.sin(l2)
    offset = a3 * math.sin(l2) + l3 * math.cos(l2)

    @compiled
    def reference(t):
        angle, rate = phase + 2 * math.pi * t / period, 2 * math.pi / period
        px, py = radius * math.cos(angle), radius * math.sin(angle)
        wx, wy, vx, vy = hx + px, hy + py, -rate * py, rate * px
        across = branch * math.sqrt(wx * wx + wy * wy - along * along)
        turned = math.atan2(hx * wy - hy * wx, hx * wx + hy * wy)
        th2 = bearing + turned - math.atan2(across, along)
        slide_rate = (wx * vx + wy * vy) / across
        turn_rate = -(vx * math.cos(th2) + vy * math.sin(th2)) / across
        last = th4 - th2 - l2
        return th2 - base, across - offset, last, turn_rate, slide_rate, -turn_rate

    return reference


def make_control(problem: Problem, compiled: Callable = lambda f: f) -> Callable:
    """Returns a function from time, positions and velocities to three efforts."""
    reference = make_reference(problem, compiled)
    (controller,) = problem.forces
    k1, k2, k3 = np.asarray(controller.kp).tolist()
    d1, d2, d3 = np.asarray(controller.kd).tolist()
    m1, m2, m3 = np.asarray(controller.limit).tolist()

    @compiled
    def control(t, q1, q2, q3, u1, u2, u3):
        r1, r2, r3, v1, v2, v3 = reference(t)
        f1 = k1 * (r1 - q1) + d1 * (v1 - u1)
        f2 = k2 * (r2 - q2) + d2 * (v2 - u2)
        f3 = k3 * (r3 - q3) + d3 * (v3 - u3)
        f1, f2, f3 = min(max(f1, -m1), m1), min(max(f2, -m2), m2), min(max(f3, -m3), m3)
        return f1, f2, f3

    return control
