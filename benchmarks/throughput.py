"""Batches of triple pendulums: simulated seconds per wall second against error.

    python -m benchmarks.throughput [--batch 1024] [--rounds 15] [--output FILE]

The paper's Fig 5 linkage from random starts around its own, 2 s. Contestants, side by
side in one process and interleaved:

- fdof_jax: `jax.vmap(simulate)`;
- plain diffrax: the same motion written as one would at first: a stacked state,
  `jnp.sin` and `jnp.cos`, a mass matrix and `linalg.solve`;
- MuJoCo: `rollout` of the exported model with its RK4, where installed.

A point's error is the worst member's largest angle error at the end, against fdof_jax
at a tolerance of 1e-13. Each point is one JSON line.
"""

import argparse
import json
import os
import platform
import subprocess
import time
from functools import partial
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

DURATION = 2.0
TS = np.array([0.0, DURATION])


def starts(batch: int) -> np.ndarray:
    """Random angles within half a radian of level, at rest, (batch, 3)."""
    return np.random.default_rng(0).uniform(-0.5, 0.5, (batch, 3))


@partial(jax.jit, static_argnames="tolerance")
def library(linkage: fj.Linkage, q0: jax.Array, tolerance: float) -> jax.Array:
    controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)

    def member(q0):
        return fj.simulate(
            linkage,
            fj.State(q0, jnp.zeros(3)),
            TS,
            stepsize_controller=controller,
            throw=False,
        ).q[-1]

    return jax.vmap(member)(q0)


def _plain_field(t, y, args):
    """The triple pendulum of point masses in absolute angles, as in a textbook."""
    mass, length, gravity = args
    angle, rate = jnp.cumsum(y[:3]), jnp.cumsum(y[3:])
    beyond = jnp.cumsum(mass[::-1])[::-1]
    shared = jnp.minimum(beyond[:, None], beyond[None, :])
    inertia = shared * length[:, None] * length[None, :]
    difference = angle[:, None] - angle[None, :]
    matrix = inertia * jnp.cos(difference)
    torque = -(inertia * jnp.sin(difference)) @ rate**2
    torque -= gravity * beyond * length * jnp.cos(angle)
    acceleration = jnp.linalg.solve(matrix, torque)
    return jnp.concatenate([y[3:], jnp.diff(acceleration, prepend=0)])


@partial(jax.jit, static_argnames="tolerance")
def plain(linkage: fj.Linkage, q0: jax.Array, tolerance: float) -> jax.Array:
    args = linkage.mass, linkage.length[1:], linkage.gravity

    def member(q0):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(_plain_field),
            diffrax.Dopri8(),
            0.0,
            DURATION,
            1e-3,
            jnp.concatenate([q0, jnp.zeros(3)]),
            args,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=65536,
            throw=False,
        ).ys[-1, :3]

    return jax.vmap(member)(q0)


class Rollout:
    """MuJoCo's own batched simulation of the exported linkage."""

    def __init__(self, linkage: fj.Linkage, q0: np.ndarray):
        import mujoco
        from mujoco import rollout

        self.model = mujoco.MjModel.from_xml_string(fj.to_mjcf(linkage))
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self.data = mujoco.MjData(self.model)
        self.rollout = rollout.rollout
        # Full physics state: time, positions, velocities.
        batch = len(q0)
        self.start = np.concatenate([np.zeros((batch, 1)), q0, np.zeros((batch, 3))], 1)

    def __call__(self, step: float) -> np.ndarray:
        self.model.opt.timestep = step
        states, _ = self.rollout(
            self.model, self.data, self.start, nstep=round(DURATION / step)
        )
        return states[:, -1, 1:4]


def measure(contestants: dict, rounds: int) -> dict:
    """Wall times of each by name, interleaved; compilation has been paid before."""
    times = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, run in contestants.items():
            began = time.perf_counter()
            jax.block_until_ready(run())
            times[name].append(time.perf_counter() - began)
    return times


def time_at(error: float, points: list[dict]) -> float:
    """Wall time at an error, between the measured points on logarithmic axes."""
    ordered = sorted((p["error"], p["time_median"]) for p in points)
    errors, walls = np.log(np.array(ordered)).T
    if not errors[0] <= np.log(error) <= errors[-1]:
        return float("nan")
    return float(np.exp(np.interp(np.log(error), errors, walls)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)

    linkage = fj.scenes.fig5().linkage
    q0 = starts(options.batch)
    exact = library(linkage, q0, 1e-13)
    runs, settings = {}, {}
    for tolerance in (1e-5, 1e-7, 1e-9, 1e-11):
        for name, function in (("fdof_jax", library), ("plain diffrax", plain)):
            key = f"{name} {tolerance:g}"
            runs[key] = partial(function, linkage, q0, tolerance)
            settings[key] = (name, tolerance)
    try:
        rollout = Rollout(linkage, q0)
    except ImportError:
        print("MuJoCo: skipped, not installed")
    else:
        for step in (4e-3, 1e-3):
            runs[f"MuJoCo {step:g}"] = partial(rollout, step)
            settings[f"MuJoCo {step:g}"] = ("MuJoCo RK4", step)

    points = []
    compile_times, errors = {}, {}
    for key, run in runs.items():
        began = time.perf_counter()
        end = np.asarray(run())
        compile_times[key] = time.perf_counter() - began
        # Absolute angles of the links are sums of relative ones.
        errors[key] = float(np.abs(np.cumsum(end - exact, axis=1)).max())
    for key, walls in measure(runs, options.rounds).items():
        name, setting = settings[key]
        quartiles = np.percentile(walls, [25, 50, 75])
        points.append(
            {
                "problem": "fig5-random-2s",
                "contestant": name,
                "setting": setting,
                "batch": options.batch,
                "dtype": "float64",
                "error": errors[key],
                "time_min": min(walls),
                "time_median": quartiles[1],
                "time_quartiles": [quartiles[0], quartiles[2]],
                "sim_seconds_per_second": options.batch * DURATION / quartiles[1],
                "first_call": compile_times[key],
                **_environment(),
            }
        )
    for point in points:
        print(
            f"{point['contestant']:14} {point['setting']:7g}  "
            f"error {point['error']:.1e}  "
            f"{point['sim_seconds_per_second']:9.3g} sim s/s"
        )
    for error in (1e-6, 1e-9):
        walls = {
            name: time_at(error, [p for p in points if p["contestant"] == name])
            for name in ("fdof_jax", "plain diffrax", "MuJoCo RK4")
        }
        for name, wall in walls.items():
            if name != "fdof_jax" and wall == wall:
                ratio = wall / walls["fdof_jax"]
                print(f"at worst error {error:g}: {ratio:.3g} times as fast as {name}")
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text("".join(json.dumps(p) + "\n" for p in points))


def _environment() -> dict:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    return {
        "jax": jax.__version__,
        "diffrax": diffrax.__version__,
        "python": platform.python_version(),
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "commit": commit,
    }


if __name__ == "__main__":
    main()
