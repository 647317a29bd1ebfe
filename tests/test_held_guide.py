"""The examples of docs/held.md run, and its table has the values of closed forms."""

import importlib.util

import numpy as np
import pytest
from test_guides import DOCS, run

PAGE = DOCS / "held.md"


@pytest.fixture(scope="module")
def held():
    spec = importlib.util.spec_from_file_location("held", DOCS / "held.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def rows(held):
    return held.rows()


@pytest.mark.slow
def test_values_are_those_of_closed_forms(rows):
    found, right = np.array([row[2:] for row in rows], float).T
    assert len(rows) == 26
    np.testing.assert_allclose(found, right, rtol=0, atol=1e-9)
    # To be held is to be held exactly.
    assert found[:3].tolist() == [0, 0, 0]


@pytest.mark.slow
def test_the_page_shows_what_the_script_prints(held, rows):
    # Rounding errors differ from machine to machine.
    lines = held.report(rows).split("\n")
    shown = PAGE.read_text().split("\n")
    begin = shown.index(lines[0]) + 1
    for line, beside in zip(lines[1:], shown[begin:]):
        assert line[:34] == beside[:34]
        two = [np.array(text[34:68].split(), float) for text in (line, beside)]
        np.testing.assert_allclose(*two, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_examples():
    names = run(PAGE)
    motion = names["motion"]
    assert set(np.unique(motion.modes)) == {0, 1, 4}
    np.testing.assert_allclose(names["slope"], np.sqrt(0.5 / 9.81), rtol=1e-9)
