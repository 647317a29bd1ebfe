"""Objects display in few words in a notebook or at a prompt, without traced values."""

import xml.etree.ElementTree as xml

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from figures import make_linkage
from test_tables import solution

import fdof_jax as fj


def cells(html: str) -> list[list[str | None]]:
    """Returns the cells of the tables in a page."""
    return [[cell.text for cell in row] for row in xml.fromstring(html).iter("tr")]


def stacked(tree, members):
    return jax.tree.map(lambda a: jnp.stack([a] * members), tree)


def test_a_solution_is_told_in_a_line_and_in_a_table():
    batch = solution(4, failed=[2])
    batch.stats["num_steps"][1] = 30
    rows = [
        ["motions", "4"],
        ["times", "5, 0 to 2 s"],
        ["outcome", "1 ill-conditioned, 3 successful"],
        ["steps", "7 to 30"],
    ]
    assert cells(batch._repr_html_()) == rows
    assert repr(batch) == f"Solution({'; '.join(map(': '.join, rows))})"
    assert "motions: 3 x 2;" in repr(solution(3, 2))
    # Objects with only the structure of a solution, for instance axes.
    axes = jax.tree.map(lambda _: 0, solution())
    assert "q=0" in repr(axes) and axes._repr_html_() is None


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_motion_says_what_its_positions_resolve(kind):
    tolerance = {np.float32: 1e-5, np.float64: 1e-11}[kind]
    for largest in 1.0, 1e2, 1e3, 1e5, 6.6e6, np.nan:
        q = np.full((5, 3), 0.1, kind)
        q[2, 1], q[3] = -largest, np.nan
        told = repr(eqx.tree_at(lambda motion: motion.q, solution(), q))
        change = np.nextafter(kind(largest), kind(np.inf)) - kind(largest)
        words = f"positions: up to {largest:.2g} m or rad, resolved to {change:.2g} in "
        assert (words in told) == (change > tolerance and np.isfinite(largest))
        assert ("resolved" in told) == (words in told)


TASK = fj.CircleTask()
PD = fj.PDController([9, 7, 5], 3, [4, 2, np.inf], TASK)
BRAKE = fj.forces.Brake([2, 3], begin=0.5)
TEXTS = {
    "PDController(kp=[9, 7, 5], kd=3, limit=[4, 2, inf], reference=CircleTask(": PD,
    "Brake(joints=[2, 3], begin=0.5, end=inf)": BRAKE,
    "joints=bool[2,8]": stacked(BRAKE, 2),
    "Point(link=2, along=0.5, across=0)": fj.Point(2, 0.5),
    "kp=f64[20,3]": stacked(PD, 20),
    "kp=key<": eqx.tree_at(lambda pd: pd.kp, PD, jax.random.key(0)),
    "ef=f64[2,6]": stacked(make_linkage("RPR"), 2),
    "ef=None": jax.tree.map(lambda _: None, make_linkage("RPR")),
}


def test_elements_and_linkages_show_their_numbers_if_they_are_few():
    for words, value in TEXTS.items():
        assert words in repr(value)
    arm = make_linkage("RPR")
    again = eval(repr(arm), {"Linkage": fj.Linkage})
    for old, new in zip(jax.tree.leaves(arm), jax.tree.leaves(again)):
        np.testing.assert_allclose(new, old, rtol=1e-5)
    assert "\n" not in repr(arm)


def test_displays_read_no_traced_values(tuned):
    shown = []
    eqx.filter_jit(lambda *values: shown.extend(map(repr, values)))(
        solution(4), make_linkage("RPR"), PD, tuned
    )
    assert shown[0] == "Solution(motions: 4; times: 5)"
    for text, words in zip(shown[1:], ("ef=f64[6]", "kp=f64[3]", "gains=f64[2,2,3]")):
        assert words in text
    assert repr(jax.eval_shape(solution)) == "Solution(motions: 1; times: 5)"


def test_a_tuning_result_is_told_in_a_line_and_in_a_table(tuned):
    line = "TuneResult(RPR, loss 0.04 to 0.01, 1 of 6 gains at a bound, not converged)"
    assert repr(tuned) == line
    rows = cells(f"<div>{tuned._repr_html_()}</div>")
    assert rows[0] == [None, "start", "tuned", "least", "greatest", None]
    numbers = ["1500", "6000", "375", "6000"]
    assert rows[1] == ["kp of R1 [N m/rad]", *numbers, "at its bound"]
    assert rows[6] == ["kd of R3 [N m s/rad]", "50", "60", "12.5", "200", None]
    assert ["rms tip error [mm]", "200", "100", None, None, None] in rows
    assert "a &lt; b" in tuned._repr_html_()
    *lines, last = str(tuned).split("\n")
    for line, row in zip(lines, rows, strict=True):
        assert " ".join(line.split()) == " ".join(filter(None, row))
    assert last == "not converged, 1 iterations: stopped where a < b"
