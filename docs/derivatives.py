"""Measures ways to derivatives: the table of gradients.md.

`python docs/derivatives.py` takes four minutes. The loss is the squared tip error of
the arm of Fig 7 on its circle, at five times within 4 s; the numbers are the six gains,
and efforts at times beside them.
"""

import statistics
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

fj.configure(x64=True)
SCENE = fj.scenes.fig7()
(PD,) = SCENE.forces
TS = np.linspace(0, 4, 5)
FORWARD = dict(adjoint=diffrax.ForwardMode())
FACTORS = np.array([0.9, 1.0, 1.1])  # three motions, with other gains each


def numbers(times):
    """Returns the gains, and efforts at so many times."""
    gains = {"kp": PD.kp, "kd": PD.kd}
    return gains | {"tau": jnp.zeros((times, 3))} if times else gains


def loss(p, **options):
    forces = [PD.replace(kp=p["kp"], kd=p["kd"])]
    if "tau" in p:
        times = np.linspace(0, 4, len(p["tau"]))
        forces.append(fj.forces.EffortHistory(times, p["tau"]))
    linkage, start, *_ = SCENE
    motion = fj.simulate(linkage, start, TS, tuple(forces), **options)
    tips = jax.vmap(lambda q: fj.tip_position(linkage, q))(motion.q)
    return jnp.sum((tips - jax.vmap(PD.reference.tip)(TS)) ** 2)


def scaled(p, factor):
    return loss(jax.tree.map(lambda x: factor * x, p))


def forward(p):
    return jax.jacfwd(lambda p: loss(p, **FORWARD))(p)


def hessian(p):
    return jax.jacfwd(forward)(p)


def in_turn(p):
    return sum(scaled(p, factor) for factor in FACTORS)


def mapped(p):
    return jax.lax.map(lambda factor: scaled(p, factor), FACTORS).sum()


def abreast(p):
    return jax.vmap(lambda factor: scaled(p, factor))(FACTORS).sum()


WAYS = {
    "the motion alone": (0, loss),
    "6 numbers, jax.grad": (0, jax.grad(loss)),
    "6 numbers, jax.jacfwd": (0, forward),
    "6 numbers, second derivatives": (0, hessian),
    "24 numbers, jax.grad (adjoint)": (6, jax.grad(loss)),
    "24 numbers, jax.jacfwd": (6, forward),
    "66 numbers, jax.grad (adjoint)": (20, jax.grad(loss)),
    "66 numbers, jax.jacfwd": (20, forward),
    "three motions, a Python loop": (0, jax.grad(in_turn)),
    "three motions, jax.lax.map": (0, jax.grad(mapped)),
    "three motions, jax.vmap": (0, jax.grad(abreast)),
}


def main():
    for name, (times, function) in WAYS.items():
        p, started = numbers(times), time.process_time()
        program = jax.jit(function).lower(p).compile()
        compiled, runs = time.process_time() - started, []
        for _ in range(8):
            started = time.process_time()
            jax.block_until_ready(program(p))
            runs.append(1e3 * (time.process_time() - started))
        run = statistics.median(runs[1:])
        print(f"{name:32s} {compiled:5.1f} s to compile, {run:6.1f} ms", flush=True)


if __name__ == "__main__":
    main()
