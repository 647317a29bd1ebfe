"""Scene 11: upright."""

import numpy as np

from hard import scenes as hard


def test_growth_beside_the_upright_equilibrium():
    """Everything grows by e each 0.1 s, roundings too: none may be lost or added."""
    upright, moved = np.array([np.pi / 2, 0, 0]), np.array([1e-6, 0, 0])
    scene = hard.free(hard.arm(), upright + moved, np.linspace(0, 1, hard.OUTPUTS))
    away = np.asarray(hard.simulate(scene, hard.TIGHT).q) - upright
    exact = [hard.linear_motion(t, upright=True) @ moved for t in scene.ts]
    size, exact_size = (np.linalg.norm(a, axis=1) for a in (away, exact))
    small = size < 1e-3
    assert 5 < small.sum() < hard.OUTPUTS
    rate, exact_rate = (np.diff(np.log(a[small])) for a in (size, exact_size))
    np.testing.assert_allclose(rate, exact_rate, rtol=0.01)
