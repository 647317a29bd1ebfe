"""The examples of docs/forces.md run, in order, as written."""

import numpy as np
import pytest
from test_guides import DOCS, run


@pytest.mark.slow
def test_examples():
    names = run(DOCS / "forces.md")
    assert names["reactions"].shape == (101, 3, 3)
    assert names["torque"].shape == (101, 3)
    assert np.isfinite(names["effort"]).all()
    half, q = names["TipLoad"](mass=1), names["emptied"].q[25]
    expected = names["fj"].mass_matrix(names["arm"], q, (half,))
    np.testing.assert_allclose(names["inertia"], expected, rtol=1e-12)
    assert 0 < names["share"][0] < 0.5 and not names["share"][1:].any()
    for motion in ("motion", "sampled", "after"):
        assert np.isfinite(names[motion].q).all()
    largest = np.abs(names["currents"]).max(axis=0)
    np.testing.assert_allclose(largest[0], 20, rtol=1e-9)
    assert (largest[1:] < 20).all()
    np.testing.assert_allclose(names["driven"].q[-1], names["target"], atol=0.01)
    assert 0 < names["fj"].analysis.margins(names["loop"]).phase
