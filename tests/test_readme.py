"""The README's Python examples run, in order, as written."""

import re
from pathlib import Path

import numpy as np
import pytest

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.slow
def test_python_examples(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) >= 4
    namespace = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), namespace)
    assert np.isfinite(namespace["motions"].q).all()
    assert namespace["result"].loss ** 0.5 < 0.07
    assert namespace["found"].converged


def test_the_first_two_shell_blocks_stand_alone():
    first, second = re.findall(r"```sh\n(.*?)```", README.read_text(), re.DOTALL)[:2]
    for block in (first, second):
        assert block.startswith("test -d .venv || python3 -m venv .venv\n")
        assert "git clone" not in block and "$ " not in block
    assert "fdof-jax" in first and "pytest" in second
