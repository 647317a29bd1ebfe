"""The examples of docs/pictures.md run, in order, as written."""

import numpy as np
import pytest
from test_guides import DOCS, run


@pytest.mark.slow
def test_examples(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(DOCS / "pictures.md")
    for name in ("motion.html", "gains.html", "arm.png", "arm.gif", "arms.gif"):
        assert (tmp_path / name).stat().st_size > 1000
    np.testing.assert_array_equal(names["table"]["P2 [m]"], names["motion"].q[:, 1])
    assert names["data"].sizes["time"] == 2001
