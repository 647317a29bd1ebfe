"""Scene 23: single precision, whose ulp is 1.2e-7."""

import re

from test_precision import run

from hard import scenes as hard

PROGRAM = """
import warnings
import jax, numpy as np
from hard import scenes as hard

assert not jax.config.jax_enable_x64
swing = hard.load("swing")
motion = hard.simulate(swing, hard.DEFAULT)
assert motion.q.dtype == np.float32
error = hard.error(motion, swing)
assert error <= 1e-3, error

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    motion = hard.simulate(swing, hard.controller(1e-8))
messages = " ".join(str(w.message) for w in caught)
for name in ("rtol", "atol"):
    assert f"{name}=1e-08 cannot be met in float32" in messages, messages
error = hard.error(motion, swing)
assert error <= 1e-3, error
print("steps:", motion.stats["num_steps"])

# After 1e6 turns neighbouring numbers are half a radian apart, and the result keeps
# the turns.
for turns in (1e4, 1e6):
    offset = np.float32(hard.START.q) + np.float32(2 * np.pi * turns)
    # The angles less their whole turns, for the angles as rounded.
    kept = np.remainder(offset.astype(float) + np.pi, 2 * np.pi) - np.pi
    plain, far = (
        hard.simulate(hard.free(hard.arm(), q, swing.ts / 5), hard.DEFAULT)
        for q in (kept, offset)
    )
    difference = (far.q - offset) - (plain.q - np.float32(kept))
    assert np.abs(difference).max() <= 1e-3 + np.spacing(offset).max(), difference
    assert np.abs(far.qd - plain.qd).max() <= 1e-3 * np.abs(plain.qd).max()
"""


def test_a_swing_and_many_turns_in_single_precision():
    """A tolerance below an ulp of the state warns, and does not fight rounding."""
    steps = re.search(r"steps: (\d+)", run(PROGRAM))
    double = hard.simulate(hard.load("swing"), hard.controller(1e-8))
    assert int(steps[1]) <= 2 * double.stats["num_steps"]
