"""The examples of docs/pictures.md run, in order, as written."""

import re
from pathlib import Path

import numpy as np
import pytest

GUIDE = Path(__file__).parents[1] / "docs" / "pictures.md"


@pytest.mark.slow
def test_examples(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for block in re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL):
        exec(compile(block, "pictures.md", "exec"), namespace)
    for name in ("arm.png", "arm.gif", "arms.gif", "workspace.png"):
        assert (tmp_path / name).stat().st_size > 1000
    table, motion = namespace["table"], namespace["motion"]
    np.testing.assert_array_equal(table["P2 [m]"], motion.q[:, 1])
    assert namespace["data"].sizes["time"] == 2001
