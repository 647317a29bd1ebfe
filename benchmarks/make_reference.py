"""Computes the motions in tests/hard/reference.json, beside the scenes' parameters.

A scene is added there, by its parameters alone. Needs heyoka (the extra `benchmark`)
and about a minute on one core:

    python -m benchmarks.make_reference

The equations come from the velocities of the mass centres per unit of each joint's
rate, not from the paper's formulas. heyoka integrates them by Taylor series in 200 bits
(60 digits). Derivatives are differences over 1e-20. Everything is computed again in 160
bits, which has to agree. All parameters are doubles, as JSON prints them.
"""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np

PATH = Path(__file__).parent.parent / "tests/hard/reference.json"
TIMES = 21  # outputs of each scene, the start among them
# Derivatives of q at the end in these arguments.
DERIVATIVES = {
    "driven-through-0-RPR": ("q0",),
    "fig5": ("q0", "mass", "length"),
    "double-pendulum": ("q0",),
    "six-pairs": ("q0", "mass"),
}
# Scenes whose accelerations along the motion are stored.
ACCELERATIONS = {"turn-slide-RPR", "near-parallel-PPR", "near-parallel-RPP"}
PARAMETERS = (
    "length", "com", "mass", "inertia", "locked", "base_angle", "gravity", "effort",
    "damping",
)  # fmt: skip


def lagrange(topology):
    """Returns the parameters, the state and its rates as heyoka's expressions."""
    import heyoka as hy

    n = len(topology)
    sizes = dict.fromkeys(PARAMETERS, n)
    sizes |= dict(length=n + 1, com=2 * n, base_angle=1, gravity=1)
    offsets = np.cumsum([0, *sizes.values()])
    par = {
        name: [hy.par[int(i)] for i in range(start, start + sizes[name])]
        for name, start in zip(PARAMETERS, offsets)
    }
    q = hy.make_vars(*(f"q{k}" for k in range(n)))
    qd = hy.make_vars(*(f"u{k}" for k in range(n)))
    (angle,), (gravity,) = par["base_angle"], par["gravity"]
    zero = hy.expression(0.0)
    M = [[zero] * n for _ in range(n)]
    rest = [f - c * u for f, c, u in zip(par["effort"], par["damping"], qd)]
    # Where a link starts, its angular velocity, and the acceleration of its start while
    # the joints keep their rates.
    x, y, rate, ax, ay = zero, zero, zero, zero, zero
    pivots, axes = [], []
    c, s = hy.cos(angle), hy.sin(angle)
    for k, joint in enumerate(topology):
        turns = joint == "R"
        length, locked = par["length"][k], par["locked"][k]
        slide = locked if turns else q[k]
        x, y = x + length * c - slide * s, y + length * s + slide * c
        inward = length * rate**2 + (zero if turns else 2 * rate * qd[k])
        aside = slide * rate**2
        ax, ay = ax - inward * c + aside * s, ay - inward * s - aside * c
        pivots.append((x, y))
        axes.append((-s, c))
        angle = angle + (q[k] if turns else locked)
        rate = rate + qd[k] if turns else rate
        c, s = hy.cos(angle), hy.sin(angle)
        along, across = par["com"][2 * k : 2 * k + 2]
        rx, ry = along * c - across * s, along * s + across * c
        pull = ax - rate**2 * rx, ay - rate**2 * ry + gravity
        # Velocities of the mass centre, and of the angle, per unit of a joint's rate.
        columns = [
            (py - y - ry, x + rx - px, 1.0) if other == "R" else (*axis, 0.0)
            for other, (px, py), axis in zip(topology, pivots, axes)
        ]
        mass, inertia = par["mass"][k], par["inertia"][k]
        for i, (vx, vy, turn) in enumerate(columns):
            rest[i] -= mass * (vx * pull[0] + vy * pull[1])
            for j, (wx, wy, also) in enumerate(columns):
                M[i][j] += mass * (vx * wx + vy * wy) + inertia * (turn * also)
    for k in reversed(range(n)):  # elimination from the tip
        for i in range(k):
            factor = M[i][k] / M[k][k]
            rest[i] -= factor * rest[k]
            M[i] = [M[i][j] - factor * M[k][j] for j in range(k)]
    qdd = []
    for k in range(n):
        known = sum((M[k][j] * qdd[j] for j in range(k)), zero)
        qdd.append((rest[k] - known) / M[k][k])
    return int(offsets[-1]), [*q, *qd], [*qd, *qdd]


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


@cache
def integrator(topology, bits, circling=False):
    import heyoka as hy

    count, state, rates = lagrange(topology)
    zero = hy.real(0.0, prec=bits)
    if circling:
        sizes = np.cumsum([0, 3, 4, 2, 2, 2, 1, 1, 2])
        pars = {
            name: [hy.par[int(i)] for i in range(begin, end)]
            for name, begin, end in zip(PARAMETERS, sizes, sizes[1:])
        }
        efforts = on_circle(hy, pars, state[:2], state[2:])
        rates = hy.subs(rates, dict(zip(pars["effort"], efforts)))
    return hy.taylor_adaptive(
        list(zip(state, rates)),
        [zero] * len(state),
        pars=[zero] * count,
        fp_type=hy.real,
        prec=bits,
        compact_mode=True,
    )


def motion(scene, changed=None, by=None, *, bits):
    """Returns the states; `changed`: (argument, index), moved by `by`."""
    import heyoka as hy

    real = lambda x: hy.real(x, prec=bits)
    values = {
        name: [real(float(x)) for x in np.ravel(scene[name])]
        for name in (*PARAMETERS, "q0", "qd0")
    }
    if changed is not None:
        name, index = changed
        values[name][index] += by
    solver = integrator(scene["topology"], bits, scene.get("circling", False))
    solver.pars[:] = sum((values[name] for name in PARAMETERS), [])
    solver.state[:] = values["q0"] + values["qd0"]
    solver.time = real(0.0)
    start = solver.state.copy()
    # From Fig 5's start the estimate of the first step fails.
    solver.propagate_until(real(1e-3))
    ts = np.linspace(0, scene["t1"], TIMES)[1:].tolist()
    outcome = solver.propagate_grid([solver.time, *map(real, ts)])
    return np.stack([start, *outcome[-1][1:]])


def accelerations(scene, states, *, bits):
    import heyoka as hy

    real = lambda values: np.array([hy.real(float(x), prec=bits) for x in values])
    _, state, rates = lagrange(scene["topology"])
    function = hy.cfunc(
        rates[len(rates) // 2 :], state, fp_type=hy.real, prec=bits, compact_mode=True
    )
    pars = real(np.concatenate([np.ravel(scene[name]) for name in PARAMETERS]))
    return np.stack([function(real(row), pars=pars) for row in states])


def derivative(scene, name, *, bits):
    """Returns the derivative of q at the end, (3, size of the argument)."""
    import heyoka as hy

    step = hy.real("1e-20", prec=bits)
    n = len(scene["topology"])
    columns = []
    for index in range(np.size(scene[name])):
        above, below = (
            motion(scene, (name, index), by, bits=bits)[-1, :n] for by in (step, -step)
        )
        columns.append((above - below) / (2 * step))
    return np.stack(columns, axis=1)


def agreed(compute, *arguments):
    """Returns the values as doubles if fewer bits give the same to 1e-20."""
    value, less = compute(*arguments, bits=200), compute(*arguments, bits=160)
    gap = np.abs(value - less).astype(float) / (1 + np.abs(value.astype(float)))
    assert gap.max() < 1e-20, gap.max()
    return value.astype(float)


def as_text(scenes):
    """Returns JSON with each row of numbers on one line."""
    text = json.dumps(scenes, indent=1) + "\n"
    return re.sub(r"\[[^][]*\]", lambda row: " ".join(row[0].split()), text)


def main():
    scenes = json.loads(PATH.read_text())
    for name, scene in scenes.items():
        print(name, flush=True)
        states = agreed(motion, scene)
        q, qd = np.split(states, 2, axis=1)
        scene["q"] = q.tolist()
        if name in ACCELERATIONS:
            qdd = agreed(accelerations, scene, states)
            scene |= dict(qd=qd.tolist(), qdd=qdd.tolist())
        for argument in DERIVATIVES.get(name, ()):
            scene[f"dq_d{argument}"] = agreed(derivative, scene, argument).tolist()
    PATH.write_text(as_text(scenes))


if __name__ == "__main__":
    main()
