"""Hard cases that are not motions of one arm, and their outcomes.

fdof_jax has to pass the tests of `tests/hard`. Those that plain diffrax can run too are
reduced to one number each, which has to stay below a bound.
"""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

from .chain import make_rates
from .hard_scenes import hard
from .measure import OUTCOMES

SOLVED, _, BY_NAME, SILENTLY = OUTCOMES

# By number of the scene: its name, and the tests of it.
TESTS = {
    18: ("chattering at a limit", "test_driven.py", "chattering"),
    19: ("derivatives at a limit", "test_driven.py", "saturation or the_limit"),
    23: ("float32", "test_single_precision.py", ""),
    24: ("jumps, a pulse of 1 us", "test_driven.py", "reference or pulse"),
    25: ("odd members of a batch", "test_batches.py", ""),
    26: ("out of steps", "test_motions.py", "out_of_steps"),
    27: ("junk in unused values", "test_traced.py", "use or fictitious"),
    28: ("losses at zero error", "test_traced.py", "everything"),
    29: ("Hessians of a batch", "../test_holding.py", "second_derivatives"),
    30: ("malformed input", "test_malformed.py", ""),
}


def tested(file: str, which: str) -> dict:
    """Returns whether the tests of a scene pass."""
    root = Path(__file__).parent.parent
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m"]
    command += ["slow or not slow", f"tests/hard/{file}", "-k", which]
    done = subprocess.run(
        command, cwd=root, capture_output=True, text=True, check=False
    )
    last = done.stdout.strip().split("\n")[-1]
    if done.returncode not in (0, 1):  # no test of that name, or none that began
        raise RuntimeError(f"{file}, {which}: {last}")
    return {"status": SILENTLY if done.returncode else SOLVED, "reason": last}


def _clipped() -> float:
    """Scene 19: the derivative of an effort at its limit, to one side or the other."""
    slope = jax.grad(lambda kp: jnp.clip(kp * 0.25, -32.0, 32.0))(128.0) / 0.25
    return min(abs(float(slope)), abs(float(slope) - 1))


def _steps_in_float32() -> float:
    """Scene 23: steps at a tolerance of 1e-8 in float32, over those in float64."""
    steps = []
    for x64 in (False, True):
        with jax.enable_x64(x64):
            steps.append(_plain(hard.load("swing"), 1e-8).stats["num_steps"])
    return float(steps[0] / steps[1])


def _pulse() -> float:
    """Scene 24: the error after a pulse of 1 us."""

    def effort(t):
        return jnp.where((t >= 7.3) & (t < 7.3 + 1e-6), 1e5, 0.0)

    exact = hard.DRIVEN["pulse"]
    scene = hard.free(hard.arm(), hard.START.q, np.array([0, *exact["ts"]]))
    q = _plain(scene, 1e-12, effort).ys[1:, :3]
    return float(np.abs(q - np.array(exact["q"])).max())


def _spoilt() -> float:
    """Scene 25: the derivative in an effort that all share, one member being NaN."""
    q0 = jnp.asarray(hard.START.q) + jnp.zeros((8, 3))
    scene = hard.free(hard.arm(), hard.START.q, np.array([0.0, 0.5]))

    def loss(effort, q0):
        def end(q0):
            moved = scene._replace(state0=fj.State(q0, scene.state0.qd))
            solution = _plain(moved, 1e-9, lambda t: effort, throw=False)
            good = solution.result == diffrax.RESULTS.successful
            return jnp.where(good, solution.ys[-1, 0], 0.0)

        return jnp.sum(jax.vmap(end)(q0))

    slope = jax.jit(jax.grad(loss))
    spoilt, clean = slope(0.0, q0.at[3, 1].set(jnp.nan)), slope(0.0, q0)
    return float(abs(spoilt - clean * 7 / 8) / abs(clean))


def _negative_mass() -> float:
    """Scene 30: whether a tip of -1 kg is accepted."""
    scene = hard.free(hard.arm(), hard.START.q, np.array([0.0, 1.0]))
    linkage = eqx.tree_at(lambda a: a.mass, scene.linkage, jnp.array([1.0, 1.0, -1.0]))
    solution = _plain(scene._replace(linkage=linkage), 1e-9, throw=False)
    return float(solution.result == diffrax.RESULTS.successful)


def _plain(scene: Any, tolerance: float, effort: Any = None, throw: bool = True) -> Any:
    """Returns the motion under `effort(t)` at the first joint."""

    control = None if effort is None else lambda t, *y: (effort(t), 0.0, 0.0)
    rates = make_rates(scene.linkage, jnp.sin, jnp.cos, control=control)

    return diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: jnp.stack(rates(*y, t))),
        diffrax.Dopri8(),
        scene.ts[0],
        scene.ts[-1],
        1e-3,
        jnp.concatenate([jnp.asarray(part, dtype=float) for part in scene.state0]),
        saveat=diffrax.SaveAt(ts=jnp.asarray(scene.ts)),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=65536,
        throw=throw,
    )


PLAIN = {19: (_clipped, 0.0), 23: (_steps_in_float32, 2.0), 24: (_pulse, 1e-8),
         25: (_spoilt, 1e-9), 30: (_negative_mass, 0.0)}  # fmt: skip


def probed(probe: Callable[[], float], bound: float) -> dict:
    """Returns the outcome of a probe of plain diffrax."""
    try:
        error = probe()
    except Exception as failure:
        return {"status": BY_NAME, "reason": f"{failure}".split("\n")[0][:200]}
    return {"status": SOLVED if error <= bound else SILENTLY, "error": error}
