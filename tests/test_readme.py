"""The README's Python examples run, in order, as written."""

import re

import numpy as np
import pytest
from test_guides import DOCS, run

README = DOCS.parent / "README.md"


@pytest.mark.slow
def test_python_examples(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(README)
    assert np.isfinite(names["motions"].q).all()
    assert names["result"].loss ** 0.5 < 0.07
    assert names["found"].converged


def test_the_first_two_shell_blocks_stand_alone():
    first, second = re.findall(r"```sh\n(.*?)```", README.read_text(), re.DOTALL)[:2]
    for block in (first, second):
        assert block.startswith("test -d .venv || python3 -m venv .venv\n")
        assert "git clone" not in block and "$ " not in block
    assert "fdof-jax" in first and "pytest" in second
