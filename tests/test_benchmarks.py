"""The benchmark suite: reading times off, recognising failures, and one run."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fdof_jax as fj
from benchmarks import contestants, page
from benchmarks.__main__ import load
from benchmarks.hard_probes import TESTS
from benchmarks.measure import RECORD, Case, envelope, measure, times_at
from benchmarks.native import Kernel
from benchmarks.pendulums import absolute, accelerations, constants, relative
from benchmarks.problems import chain, random_linkage

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

    wrong = [_case("bad", error) for error in (np.nan, np.inf, 0.2)]
    for bad in (*wrong, Case("b", 1.0, fall)):
        good, failed = measured(_case("good", 1e-3), bad)
        assert good["status"] == "ok" and len(good["times"]) == 3
        assert failed["status"] == "failed" and failed["times"] is None
        assert times_at([failed], 0.5) is None
    assert "no" in failed["reason"]


@pytest.fixture(scope="module")
def three_motions():
    """Returns an arm, three starts, and where their motions are at two times."""
    rng = np.random.default_rng(0)
    linkage = random_linkage("RRR", rng)
    starts = rng.uniform(-1, 1, (2, 3, 3))
    ts = np.array([0.0, 0.5, 1.0])
    run = lambda *start: fj.simulate(linkage, start, ts, rtol=1e-13, atol=1e-13)
    return linkage, starts, np.stack([run(*start).q[1:] for start in zip(*starts)])


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
@pytest.mark.parametrize("method, step", [("RK4", 2e-4), ("order 8", 5e-3)])
def test_the_c_kernel_agrees_with_the_library(method, step, three_motions):
    linkage, starts, exact = three_motions
    for batch in (1, 3):
        kernel = Kernel(method, linkage, *starts[:, :batch])
        q, _ = kernel.joints(kernel(step, round(0.5 / step), saves=2))
        np.testing.assert_allclose(q, exact[:batch], atol=1e-9)


def test_equations_of_peers_are_those_of_the_library():
    """They agree to 1e-12 of the accelerations before anything is timed."""
    rng = np.random.default_rng(1)
    arms = random_linkage("RRR", rng), fj.scenes.fig5().linkage, chain(5, 1).linkage
    for linkage in arms:
        n = len(linkage.mass)
        arm, (q, qd) = constants(linkage), rng.uniform(-2, 2, (2, n))
        exact = np.asarray(fj.forward_dynamics(linkage, q, qd, np.zeros(n)))
        y = absolute(arm, q, qd)
        np.testing.assert_allclose(relative(arm, y), [q, qd], atol=1e-14)
        turns = accelerations(arm, *y.reshape(2, n), np.sin, np.cos)
        found = [np.diff(turns, prepend=0)]
        if linkage is arms[1]:  # in arrays
            rates = contestants._textbook_field(0, np.append(q, qd), (linkage, ()))
            found.append(rates[3:])
        for qdd in found:
            assert np.abs(qdd - exact).max() < 1e-12 * np.abs(exact).max()


def strict(constant):
    raise ValueError(f"not JSON: {constant}")


@pytest.mark.slow
def test_the_number_of_joints_is_measured_end_to_end(tmp_path):
    options = "--quick", "--only", "joints", "--output", str(tmp_path)
    command = [sys.executable, "-m", "benchmarks", *options]
    env = os.environ | {"JAX_PLATFORMS": "cpu"}
    result = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    lines = (tmp_path / "joints.jsonl").read_text().splitlines()
    points = [json.loads(line, parse_constant=strict) for line in lines]
    about = {"job", "versions", "cpu", "cores", "load", "commit"}
    assert all({*RECORD} | about <= set(point) for point in points)
    own = [p for p in points if p["solver"] in ("fdof_jax", "fdof_jax sweep")]
    assert {p["batch"] for p in own} == {1, 16}
    assert all(p["status"] == "ok" and p["flops"] > 0 for p in own)
    assert min(p["error"] for p in own) < 1e-9
    assert "16 arms [s per s]" in result.stdout


def test_ratios_are_those_of_rounds():
    points = measured(_case("fast", 1e-3), _case("slow", 1e-9), ratio_to="fast")
    assert points[0]["ratio"] == pytest.approx(1.0)
    assert points[1]["ratio_to"] == "fast" and points[1]["ratio"] > 0
    point = {"status": "ok", "error": 1e-9, "simulated": 1.0}
    ours = [point | {"times": [1.0, 2.0, 1.0]}]
    others = [point | {"times": [3.0, 8.0, 5.0], "simulated": 0.5}]
    assert page.ratio(ours, others, 1e-6) == "8 (7 to 9)"
    assert page.ratio(ours, others, 1e-12) == "-"


def test_the_page_is_that_of_the_results_of_one_commit():
    point = {"cpu": "one", "date": "today", "versions": {}, "commit": "a"}
    assert "commit a" in page.machine({"x": [point], "y": [point]})
    with pytest.raises(ValueError, match="those of one commit"):
        page.machine({"x": [point], "y": [point | {"commit": "b"}]})
    text = (ROOT / "benchmarks/README.md").read_text()
    assert page.filled(text, page.texts(load(ROOT / "benchmarks/results"))) == text
    assert text.count("\n") <= 200


def test_other_pages_quote_only_what_the_page_shows():
    numbers = lambda text: set(re.findall(r"\d[\d.]*\d(?:e-?\d+)?|\d+e-?\d+", text))
    shown = numbers((ROOT / "benchmarks/README.md").read_text())
    text = (ROOT / "docs/comparison.md").read_text()
    speeds = numbers(text.split("## How fast")[1].split("\n## ")[0])
    quoted = speeds - {"1e-3", "1e-6", "1e-9"}
    assert len(quoted) >= 6 and quoted <= shown


def test_hard_cases_name_tests_that_are_there():
    for _, file, which in TESTS.values():
        text = (Path(__file__).parent / "hard" / file).read_text()
        names = " ".join(re.findall(r"def (test_\w+)", text))
        assert names and all(word in names for word in which.split(" or "))
