"""Scene 16: small swings for a day."""

import numpy as np
import pytest

from hard import scenes as hard


@pytest.mark.parametrize(
    "seconds, bound", [(1e4, 1e-9), pytest.param(1e5, 1e-8, marks=pytest.mark.slow)]
)
def test_energy_of_a_small_swing(seconds, bound):
    """Errors of each step add up, and the time itself is rounded."""
    scene = hard.free(
        hard.arm(), [0.1 - np.pi / 2, 0, 0], np.linspace(0, seconds, hard.OUTPUTS)
    )
    motion = hard.simulate(scene, hard.TIGHT)
    assert hard.drift(scene.linkage, motion.q, motion.qd) <= bound
