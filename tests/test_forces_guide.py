"""The examples of docs/forces.md run, in order, as written."""

import re
from pathlib import Path

import numpy as np
import pytest

GUIDE = Path(__file__).parents[1] / "docs" / "forces.md"


@pytest.mark.slow
def test_examples():
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    namespace = {}
    for block in blocks:
        exec(compile(block, "forces.md", "exec"), namespace)
        if "motion" in namespace:
            assert np.isfinite(namespace["motion"].q).all()
    assert namespace["reactions"].shape == (101, 3, 3)
    assert namespace["torque"].shape == (101, 3)
    assert np.isfinite(namespace["effort"]).all()
    assert 0 < namespace["share"][0] < 0.5 and not namespace["share"][1:].any()
    assert np.isfinite(namespace["sampled"].q).all()
    assert np.isfinite(namespace["after"].q).all()
    np.testing.assert_allclose(
        namespace["traced"].q[-1],
        namespace["around"](1.0, namespace["pendulum"])[0],
        atol=0.05,
    )
    assert 0.5 < namespace["rolling"].q[-1, 0] < 1.0  # 2 N on 1 to 1.3 kg
