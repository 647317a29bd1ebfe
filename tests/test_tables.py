"""Solutions as labelled arrays; objects in few words at a prompt or in a notebook."""

import sys
import xml.etree.ElementTree as xml

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray
from chains import random_chain
from figures import make_linkage

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

TS = np.linspace(0, 2, 5)


def solution(*batch, failed=()) -> fj.Solution:
    """Returns a solution without a solve; for a batch, some motions have failed."""
    q = np.random.default_rng(0).normal(size=(2, *batch, len(TS), 3))
    good = np.ones(batch, bool)
    for place in failed:
        q[:, place, 1:] = np.nan
        good[place] = False
    results = diffrax.RESULTS.successful, diffrax.RESULTS.singular
    chosen = lambda good: diffrax.RESULTS.where(good, *results)
    for _ in batch:
        chosen = jax.vmap(chosen)
    stats = {"num_steps": np.full(batch, 7), "time_reached": np.where(good, 2.0, 0.1)}
    ts, (q, qd) = jnp.broadcast_to(TS, (*batch, len(TS))), map(jnp.asarray, q)
    return fj.Solution(ts, q, qd, stats, chosen(good))


def test_a_motion_has_named_joints_with_units():
    motion, arm = solution(), make_linkage("RPR")
    found = fj.to_xarray(arm, motion)
    assert dict(found.sizes) == {"time": 5, "joint": 3}
    assert found.joint.values.tolist() == ["R1", "P2", "R3"]
    assert found.unit.values.tolist() == ["rad", "m", "rad"]
    assert found.q.units == "m or rad" and found.qd.units == "m/s or rad/s"
    assert found.time.units == found.time_reached.units == "s"
    np.testing.assert_array_equal(found.q.sel(joint="P2"), motion.q[:, 1])
    np.testing.assert_array_equal(found.qd.sel(time=1.0), motion.qd[2])
    assert (found.outcome, found.num_steps) == ("successful", 7)
    assert fj.to_xarray(make_linkage("RRR"), motion).qd.units == "rad/s"
    table = fj.to_pandas(arm, motion)
    units = dict(zip(("R1", "P2", "R3"), ("rad", "m", "rad")))
    positions = [f"{name} [{unit}]" for name, unit in units.items()]
    velocities = [f"{name} [{unit}/s]" for name, unit in units.items()]
    assert list(table) == [*positions, *velocities, "outcome"]
    assert table.index.name == "time [s]" and table.index.tolist() == TS.tolist()
    np.testing.assert_array_equal(table[positions], motion.q)
    np.testing.assert_array_equal(table[velocities], motion.qd)
    assert set(table.outcome) == {"successful"}


@pytest.mark.slow
def test_held_joints_are_told_alike_in_memory_and_in_a_store(tmp_path):
    arm = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
    friction = jax.vmap(fj.forces.JointFriction)(jnp.array([[1.0], [50.0]]))
    batch = arm, fj.State([0.0], [0.0]), TS, (friction,)
    options = dict(forces_axes=0, solver=LoopedDopri8())  # which compiles faster
    motions = fj.sweep(*batch, **options)
    data = fj.to_xarray(arm, motions).rename(batch="member")
    fj.sweep(*batch, **options, store=tmp_path)
    with xarray.open_zarr(tmp_path) as there:
        for name in ("modes", "taken"):
            assert there[name].dims == data[name].dims
            assert there[name].attrs == data[name].attrs
            np.testing.assert_array_equal(there[name], data[name])
    words = data.modes.flag_meanings.split()
    assert words == ["free", "friction", "lower_stop", "upper_stop", "brake"]
    assert data.modes[:, -1, 0].values.tolist() == [0, words.index("friction")]
    held = fj.to_pandas(arm, motions)["R1 held by"]
    assert held[:, TS[-1]].tolist() == ["free", "friction"]


def test_a_batch_has_axes_and_says_what_failed():
    arm, motion = make_linkage("RRP"), solution(4, failed=[2])
    found = fj.to_xarray(arm, motion)
    assert found.q.dims == ("batch", "time", "joint")
    np.testing.assert_array_equal(found.q, motion.q)
    good = ["successful", "successful", "ill-conditioned", "successful"]
    assert found.outcome.values.tolist() == good
    assert found.time_reached.values.tolist() == [2, 2, 0.1, 2]
    assert fj.to_pandas(arm, motion).index.names == ["batch", "time [s]"]
    motion = solution(3, 2, failed=[(1, 0)])
    found, table = fj.to_xarray(arm, motion), fj.to_pandas(arm, motion)
    assert found.q.dims == ("batch_1", "batch_2", "time", "joint")
    assert found.outcome.dims == ("batch_1", "batch_2")
    assert table.index.names == ["batch_1", "batch_2", "time [s]"]
    row = table.loc[2, 1, TS[3]]
    assert row["P3 [m]"] == motion.q[2, 1, 3, 2]
    assert row["R1 [rad/s]"] == motion.qd[2, 1, 3, 0]
    failed = table[table.outcome != "successful"]
    assert set(failed.index.droplevel("time [s]")) == {(1, 0)}


def test_names_of_joints_of_two_kinds_and_of_any_number():
    arms = jax.tree.map(lambda *a: jnp.stack(a), *map(make_linkage, ("RRP", "RPP")))
    found = fj.to_xarray(arms, solution(2))
    assert found.joint.values.tolist() == ["R1", "2", "P3"]
    assert found.unit.values.tolist() == ["rad", "m or rad", "m"]
    assert "2 [m/s or rad/s]" in fj.to_pandas(arms, solution(2))
    arm, motion = random_chain("RFPRR", np.random.default_rng(5)), solution()
    five = fj.Solution(motion.ts, *[np.ones((5, 5))] * 2, motion.stats, motion.result)
    names = ["R1", "F2", "P3", "R4", "R5"]
    assert fj.to_xarray(arm, five).joint.values.tolist() == names
    columns = list(fj.to_pandas(arm, five).columns)
    assert [column.split()[0] for column in columns[:5]] == names


def test_a_package_that_is_missing_is_named_with_the_extra(monkeypatch):
    for name, call in ("xarray", fj.to_xarray), ("pandas", fj.to_pandas):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(ImportError, match=rf"{name} .*fdof_jax\[data\]"):
            call(make_linkage("RRR"), solution())


# Words, without traced values


def cells(html: str) -> list[list[str | None]]:
    """Returns the cells of the tables in a page."""
    return [[cell.text for cell in row] for row in xml.fromstring(html).iter("tr")]


def stacked(tree, members):
    return jax.tree.map(lambda a: jnp.stack([a] * members), tree)


def test_a_solution_is_told_in_a_line_and_in_a_table():
    batch = solution(4, failed=[2])
    batch.stats["num_steps"][1] = 30
    rows = [
        ["motions", "4"], ["times", "5, 0 to 2 s"],
        ["outcome", "1 ill-conditioned, 3 successful"], ["steps", "7 to 30"],
    ]  # fmt: skip
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


def test_a_tuning_result_is_told_in_a_line_in_a_table_and_in_a_frame(tuned):
    line = "TuneResult(RPR, loss 0.04 to 0.01, 1 of 6 gains at a bound, not converged)"
    assert repr(tuned) == line
    rows = cells(f"<div>{tuned._repr_html_()}</div>")
    assert rows[0] == [None, "start", "tuned", "least", "greatest", None]
    numbers = ["1500", "6000", "375", "6000"]
    assert rows[1] == ["kp of R1 [N m/rad]", *numbers, "at its bound"]
    assert rows[6] == ["kd of R3 [N m s/rad]", "50", "60", "12.5", "200", None]
    assert ["rms tip error [mm]", "200", "100", None, None, None] in rows
    assert "a &lt; b" in tuned._repr_html_()
    found = pd.DataFrame(tuned.table).set_index(["gain", "joint"])
    assert found.tuned["kp", "P2"] == tuned.gains[0, 1]
    assert found.unit["kd", "R1"] == "N m s/rad" and found.unit["kp", "P2"] == "N/m"
    assert found.at_bound.sum() == 1
    *lines, last = str(tuned).split("\n")
    for line, row in zip(lines, rows, strict=True):
        assert " ".join(line.split()) == " ".join(filter(None, row))
    assert last == "not converged, 1 iterations: stopped where a < b"
