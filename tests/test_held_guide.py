"""The examples of docs/held.md run, and its table has the values of closed forms."""

import importlib.util

import numpy as np
import pytest
from test_guides import DOCS, run

PAGE = DOCS / "held.md"


@pytest.mark.slow
def test_the_page_shows_values_that_are_those_of_closed_forms():
    spec = importlib.util.spec_from_file_location("held", DOCS / "held.py")
    held = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(held)
    rows = held.rows()
    found, right = np.array([row[2:] for row in rows], float).T
    np.testing.assert_allclose(found, right, rtol=0, atol=1e-9)
    # To be held is to be held exactly.
    assert len(rows) == 26 and found[:3].tolist() == [0, 0, 0]
    # Rounding errors differ from machine to machine.
    table = held.report(rows).split("\n")
    page = PAGE.read_text().split("\n")
    begin = page.index(table[0]) + 1
    shown = page[begin : begin + len(table) - 1]
    assert [line[:51] for line in table[1:]] == [line[:51] for line in shown]


@pytest.mark.slow
def test_examples():
    names = run(PAGE)
    assert set(np.unique(names["motion"].modes)) == {0, 1, 4}
    np.testing.assert_allclose(names["slope"], np.sqrt(0.5 / 9.81), rtol=1e-9)
