"""The benchmark suite: reading times off, recognising failures, and one run."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import batches, page, targets
from benchmarks.circle import make_control, make_reference
from benchmarks.measure import RECORD, Case, envelope, measure, times_at
from benchmarks.native import Kernel
from benchmarks.problems import fig7, random_linkage
from benchmarks.tables import switches_table
from fdof_jax import State, simulate

ROOT = Path(__file__).parent.parent


def test_envelope():
    """It is a line on logarithmic axes, of the points that no other beats in both."""
    errors, times = [1e-2, 1e-4, 1e-6], [1.0, 500.0, 100.0]
    assert envelope(errors, times, 1e-4) == pytest.approx(10.0)
    assert envelope(errors, times, 1e-6) == pytest.approx(100.0)
    assert envelope(errors, times, 1e-1) == pytest.approx(1.0)  # a bound
    assert np.isnan(envelope(errors, times, 1e-7))  # it does not extrapolate
    assert np.isnan(envelope([], [], 1e-3))


def _case(solver, error):
    return Case(solver, 1e-3, lambda: error, lambda error: {"error": error})


def measured(*cases, **options):
    return measure("test", cases, budget=0, rounds=3, **options)


def test_a_failed_run_is_never_a_win():
    def fall():
        raise RuntimeError("no")

    for bad in (
        *(_case("bad", e) for e in (np.nan, np.inf, 0.2)),
        Case("b", 1.0, fall),
    ):
        good, failed = measured(_case("good", 1e-3), bad)
        assert good["status"] == "ok" and len(good["times"]) == 3
        assert failed["status"] == "failed" and failed["times"] is None
        assert times_at([failed], 0.5) is None
    assert "no" in failed["reason"]


def test_ratios_are_taken_at_equal_error():
    cases = _case("fast", 1e-3), _case("slow", 1e-3), _case("unreachable", 1e-9)
    points = measured(*cases, ratio_to="fast")
    assert points[0]["ratio"] == pytest.approx(1.0)
    assert points[1]["ratio_to"] == "fast" and points[2]["ratio"] is None


def test_what_was_not_measured_of_switches_is_a_dash():
    point = {"problem": "cable", "setting": 1e-11, "solver": "plain", "batch": 1}
    point |= {"parameters": 1, "switches": 0.0, "error": 0.13, "steps": 138.0}
    ways = [point | {"solver": "forward mode", "error": 5e-11, "steps": 55}, point]
    *_, row = switches_table(ways).split("\n")
    assert row == "| cable | 1 | 1 | 0 | 5.0e-11 | 55 | 0.13 | 140 | 1.0e-11 |"
    only = switches_table([*ways, ways[0] | {"problem": "move"}]).split("\n")[-1]
    assert only == "| move | 1 | 1 | 0 | 5.0e-11 | 55 | - | - | 1.0e-11 |"


@pytest.fixture(scope="module")
def three_motions():
    rng = np.random.default_rng(0)
    linkage = random_linkage("RRR", rng)
    state0 = State(rng.uniform(-1, 1, (3, 3)), rng.uniform(-1, 1, (3, 3)))
    ts = np.array([0.0, 0.5, 1.0])
    alone = [
        simulate(linkage, State(*start), ts, rtol=1e-13, atol=1e-13)
        for start in zip(*state0)
    ]
    return linkage, state0, np.stack([motion.q[1:] for motion in alone])


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
@pytest.mark.parametrize("method, step", [("RK4", 2e-4), ("order 8", 5e-3)])
@pytest.mark.parametrize("batch", [1, 3])
def test_the_c_kernel_agrees_with_the_library(method, step, batch, three_motions):
    linkage, state0, exact = three_motions
    q0, qd0 = (rows[:batch] for rows in state0)
    kernel = Kernel(method, linkage, q0, qd0)
    q, _ = kernel.joints(kernel(step, round(0.5 / step), saves=2))
    np.testing.assert_allclose(q, exact[:batch], atol=1e-9)


def test_the_circle_in_scalars_is_that_of_the_library():
    problem = fig7()
    (controller,) = problem.forces
    reference, control = make_reference(problem), make_control(problem)
    rng = np.random.default_rng(0)
    for t in np.linspace(0, 10, 9):
        q, qd = controller.reference(t, problem.linkage)
        np.testing.assert_allclose(reference(t), [*q, *qd], rtol=1e-12, atol=1e-12)
        state = np.concatenate([q, qd]) + rng.uniform(-0.3, 0.3, 6)
        effort = controller(t, state[:3], state[3:], problem.linkage)
        np.testing.assert_allclose(control(t, *state), effort, rtol=1e-9, atol=1e-9)


def points_of(folder, name):
    def refuse(constant):
        raise ValueError(f"not JSON: {constant}")

    lines = (folder / f"{name}.jsonl").read_text().splitlines()
    return [json.loads(line, parse_constant=refuse) for line in lines]


@pytest.mark.slow
def test_the_number_of_joints_is_measured_end_to_end(tmp_path):
    command = [sys.executable, "-m", "benchmarks", "--quick"]
    result = subprocess.run(
        [*command, "--only", "joints", "--output", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    points = points_of(tmp_path, "joints")
    for point in points:
        assert set(RECORD) <= set(point)
        assert {"job", "versions", "cpu", "cores", "load", "commit"} <= set(point)
    own = [p for p in points if p["solver"] == "fdof_jax"]
    assert {p["batch"] for p in own} == {1, 16}
    assert all(p["status"] == "ok" and p["flops"] > 0 for p in own)
    assert min(p["error"] for p in own) < 1e-9
    assert (tmp_path / "joints.png").stat().st_size > 1000
    assert "simulated s per s" in page.tables({"joints": points})["joints"]


def test_tables_go_between_their_markers():
    points = points_of(ROOT / "benchmarks/results", "generality")
    texts = page.tables({"generality": points})
    text = "before\n<!-- begin: generality -->old<!-- end: generality -->\nafter"
    filled = page.filled(text, texts)
    assert "EF as arrays" in filled and "old" not in filled
    assert filled.startswith("before") and filled.endswith("after")
    assert page.filled(filled, texts) == filled
    rows = list(targets.targets({"generality": points}, page.number))
    assert len(rows) == 3 and all(len(row) == 5 for row in rows)


@pytest.mark.parametrize("batch", [16, 64, 1024, 16384, 131072])
def test_batches_of_every_size_have_contestants(batch):
    assert {"fdof_jax", "heyoka"} <= {name for name, _, _ in batches.table(batch)}
