"""PD control of two links whose tip tracks a circle, in heyoka's expressions."""

import numpy as np


def on_circle(hy, arm, q, qd):
    """Returns the efforts of PD control (100, 10) of two links on a circle.

    Its centre is (0.7, 0), its radius 0.3 m, its period 2 s.
    """
    turn = 2 * np.pi / 2.0
    c, s = hy.cos(turn * hy.time), hy.sin(turn * hy.time)
    x, y = 0.7 + 0.3 * c, 0.3 * s
    vx, vy = -0.3 * turn * s, 0.3 * turn * c
    first, second = arm["length"][1:]
    bend = hy.acos((x**2 + y**2 - first**2 - second**2) / (2 * first * second))
    lever = first + second * hy.cos(bend), second * hy.sin(bend)
    angle = hy.atan2(y, x) - hy.atan2(lever[1], lever[0])
    # Rates of the tip per unit of each joint's rate.
    tip = second * hy.cos(angle + bend), second * hy.sin(angle + bend)
    determinant = first * second * hy.sin(bend)
    rates = (tip[0] * vx + tip[1] * vy) / determinant, -(x * vx + y * vy) / determinant
    return [
        100 * (wanted - a) + 10 * (rate - u)
        for wanted, a, rate, u in zip((angle, bend), q, rates, qd)
    ]
