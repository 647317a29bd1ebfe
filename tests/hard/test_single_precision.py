"""Scene 23: single precision, whose ulp is 1.2e-7, in a process of its own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import diffrax
import numpy as np
import pytest
from helpers import programs

import fdof_jax as fj
from hard.scenes import DRIVEN, arm

SWING = DRIVEN["swing"]
TS = np.linspace(0, SWING["t1"], 21)

# One process for all tests, because importing takes seconds.
PROGRAM = """
import warnings
import diffrax, jax, jax.numpy as jnp, numpy as np
import fdof_jax as fj
from hard.scenes import DRIVEN, arm

assert not jax.config.jax_enable_x64
swing = DRIVEN["swing"]
start = fj.State(swing["q0"], swing["qd0"])
ts = np.linspace(0, swing["t1"], 21)
steps = diffrax.PIDController(rtol=1e-5, atol=1e-5)
for controller in (None, steps):
    motion = fj.simulate(arm(), start, ts, stepsize_controller=controller)
    assert motion.q.dtype == np.float32
    error = np.abs(motion.q - np.array(swing["q"])).max()
    assert error <= 1e-3, error
print("swung", flush=True)

steps = diffrax.PIDController(rtol=1e-8, atol=jnp.asarray(1e-8))
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    motion = fj.simulate(arm(), start, ts, stepsize_controller=steps)
messages = [str(w.message) for w in caught]
for name in ("rtol", "atol"):
    told = f"{name}=1e-08 cannot be met in float32"
    assert any(told in m for m in messages), messages
error = np.abs(motion.q - np.array(swing["q"])).max()
assert error <= 1e-3, error
print("steps:", motion.stats["num_steps"], flush=True)

for turns in (1e4, 1e6):
    offset = np.array([-0.5, 0.3, 0.2], np.float32) + np.float32(2 * np.pi * turns)
    # The angles less their whole turns, for the angles as rounded.
    kept = np.remainder(offset.astype(float) + np.pi, 2 * np.pi) - np.pi
    plain, far = (
        fj.simulate(arm(), fj.State(q, [0, 0, 0]), ts / 5) for q in (kept, offset)
    )
    difference = (far.q - offset) - (plain.q - np.float32(kept))
    assert np.abs(difference).max() <= 1e-3 + np.spacing(offset).max(), difference
    assert np.abs(far.qd - plain.qd).max() <= 1e-3 * np.abs(plain.qd).max()
    print(f"turned {turns:g} times", flush=True)
"""


@pytest.fixture(scope="module")
def done():
    tests = Path(__file__).parents[1]
    environment = os.environ | {"JAX_ENABLE_X64": "0", "PYTHONPATH": str(tests)}
    return subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment | programs(),
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_swing_of_ten_seconds(done):
    """Every step adds its rounding, half an ulp of the state."""
    assert "swung" in done.stdout, done.stderr[-3000:]


def test_a_tolerance_out_of_reach_warns_and_does_not_fight_rounding(done):
    """Below an ulp of the state the error estimate is noise."""
    steps = re.search(r"steps: (\d+)", done.stdout)
    assert steps, done.stderr[-3000:]
    same = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    start = fj.State(SWING["q0"], SWING["qd0"])
    double = fj.simulate(arm(), start, TS, stepsize_controller=same)
    assert int(steps[1]) <= 2 * double.stats["num_steps"]


@pytest.mark.parametrize("turns", [1e4, 1e6])
def test_turns_do_not_matter(turns, done):
    """After 1e6 turns neighbouring numbers are half a radian apart.

    The result keeps the turns, so the bound is 1e-3 or an ulp of it.
    """
    assert f"turned {turns:g} times" in done.stdout, done.stderr[-3000:]
