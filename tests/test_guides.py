"""The examples of the guides run, in order, as written."""

import re
from pathlib import Path

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.special import ellipk

DOCS = Path(__file__).parents[1] / "docs"


def run(page):
    """Runs the Python blocks of a page, with JAX's defaults; returns their names."""
    plt.close("all")  # those of other pages
    namespace = {}
    with jax.numpy_rank_promotion("allow"):
        for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
            exec(compile(block, page.name, "exec"), namespace)
    return namespace


@pytest.mark.slow
def test_batches():
    names = run(DOCS / "batches.md")
    assert np.isfinite(names["motions"].q).all()
    assert np.isfinite(names["many"].q).all()


@pytest.mark.slow
def test_comparison():
    names = run(DOCS / "comparison.md")
    np.testing.assert_allclose(names["data"].qpos, names["motion"].q[-1], atol=1e-5)
    np.testing.assert_allclose(names["again"].mass, names["arm"].mass)
    np.testing.assert_allclose(names["dampers"][0].coefficient, 0.5)
    np.testing.assert_allclose(names["start"].q, 0)


@pytest.mark.slow
def test_models(monkeypatch):
    monkeypatch.chdir(DOCS.parent)
    page = (DOCS / "models.md").read_text()
    names = run(DOCS / "models.md")
    np.testing.assert_allclose(names["motion"].q[-1], 0, atol=0.02)
    assert names["tuned"].tip_error < 0.02
    first = str(names["fj"].from_mjcf("docs/models/cart_pole.xml").account)
    assert first in page  # which shows what it prints


@pytest.mark.slow
def test_gradients():
    names = run(DOCS / "gradients.md")
    np.testing.assert_allclose(names["reverse"], names["forward"], rtol=1e-6)


@pytest.mark.slow
def test_switches():
    names = run(DOCS / "switches.md")
    assert names["found"].stats["num_switches"] >= 1
    assert names["wet"].stats["num_switches"] >= 1
    assert np.isfinite(names["slope"]).all()


@pytest.mark.slow
def test_conditions():
    names = run(DOCS / "conditions.md")
    fall, fall_change = np.sqrt(0.35 / 4.905) * ellipk(0.5), 0.25 / 0.35 - 1
    np.testing.assert_allclose(names["time"], fall, rtol=1e-11)
    np.testing.assert_allclose(names["change"], fall * fall_change / 2, rtol=1e-9)
    half = np.sin(0.4) ** 2
    phases = [2 * np.sqrt(x / 9.81) * ellipk(half / x) for x in (1, 0.6, 1, 0.6)]
    times = np.cumsum(phases) - phases[0] / 2
    found = names["swings"].events.table["t [s]"]
    np.testing.assert_allclose(found, times, rtol=0, atol=1e-9)
    np.testing.assert_allclose(names["multiplier"], [[names["kept"] ** 2]], rtol=1e-9)
    locked = np.sqrt(1.5 * names["one"] * names["two"] / 1.3)
    np.testing.assert_allclose(names["locked"], locked, rtol=1e-10)
    np.testing.assert_allclose(names["sooner"], -locked / 8, rtol=1e-9)


@pytest.mark.slow
def test_tuning(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(DOCS / "tuning.md")
    assert names["result"].loss ** 0.5 < 0.07
    assert 0 < names["priced"].effort < 0.5
    # The last arm is PPR, whose errors stand in the table.
    assert names["tuned"].tip_error == pytest.approx(4.272e-3, rel=1e-3)


@pytest.mark.slow
def test_gains(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(DOCS / "gains.md")
    assert np.isfinite(names["fj"].analysis.margins(names["slower"])).all()
    assert names["found"].met.shape == (12,) and names["found"].met.all()


@pytest.mark.slow
def test_identification():
    names = run(DOCS / "identification.md")
    found, both = names["found"], names["both"]
    assert found.usable and both.usable and not names["alike"].usable
    assert abs(both.parameters["mass"] - 1.3) < 1e-4
    # By far the largest relative standard errors are those of the damping.
    errors = [fit.standard_errors["damping"] / [4, 6, 0.5] for fit in (found, both)]
    gain = max(errors[0]) / max(errors[1])
    assert gain > 3 and gain == pytest.approx(names["chosen"].improvement, rel=0.05)


@pytest.mark.slow
def test_hard_cases():
    two = run(DOCS / "hard-cases.md")["two"]
    assert two.outcome.tolist() == ["successful", "not finite"]


@pytest.mark.slow
def test_recipes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(DOCS / "recipes.md")
    assert names["response"].settling_time[0] < 1.5
    assert (names["loop"].poles().real < 0).all()
    # A turn by 1.5 rad sweeps 1.5 r dr; half the square of the radius r is 1 + cos(q2).
    cells = np.isfinite(names["counts"]).sum()
    area = cells * np.diff(names["x"])[0] * np.diff(names["y"])[0]
    np.testing.assert_allclose(area, 1.5 * (np.cos(0.5) - np.cos(2.5)), rtol=0.05)
    # Forces of the one ellipse take shares of the limits with a sum of squares of 1.
    fj, J = names["fj"], names["J"]
    efforts = J.T @ names["strong"] / names["limit"][:, None]
    np.testing.assert_allclose(np.linalg.norm(efforts, axis=0), 1)
    # Forces of a newton accelerate the tip to the other.
    floats = names["arm"].replace(gravity=0)
    moved = [
        J @ fj.forward_dynamics(floats, [0.4, 1.2], [0, 0], J.T @ push)
        for push in np.eye(2)
    ]
    pushes = np.linalg.solve(np.transpose(moved), names["easy"])
    np.testing.assert_allclose(np.linalg.norm(pushes, axis=0), 1)
    names["show"](length=0.5)  # errors within `interact` are only printed
    assert names["value"] < 0.06
    assert eqx.tree_equal(names["kept"], names["policy"])
    assert names["rewards"].shape == (500, 256) and names["done"].sum() >= 512
    assert names["found"].success and names["found"].fun < 0.01
    assert names["room"](names["found"].x).min() > -1e-6
    np.testing.assert_allclose(names["slope"], names["difference"], rtol=1e-6)
    np.testing.assert_allclose(names["robust"].x, [1, 2], rtol=1e-4)
    assert names["efforts"].shape == (26, 2) and abs(names["efforts"]).max() <= 12
    assert not names["efforts"][:, 1].any()
    push = names["fj"].forces.EffortHistory(np.linspace(0, 2.5, 26), names["efforts"])
    upright = names["fj"].simulate(names["cart"], names["down"], [0, 2.5], (push,))
    np.testing.assert_allclose(upright.q[-1], [0, np.pi], atol=1e-6)
    assert names["fastest"].success
    np.testing.assert_allclose(np.exp(names["fastest"].x[0]), 1, rtol=1e-6)
    np.testing.assert_allclose(names["steady"].q[-1], names["upright"], atol=1e-6)
    assert 0.0220 < (2 * names["best"].cost) ** 0.5 < 0.0226  # the controller: 0.0501
    np.testing.assert_allclose(names["state"].q, names["upright"], atol=1e-2)
    assert (names["result"] == names["diffrax"].RESULTS.successful).all()
    fallen = names["fj"].simulate(names["falls"], [0, 1.234, 3.0])
    np.testing.assert_allclose(names["between"], fallen.q[1], atol=1e-6)
    last = names["fj"].tip_position(names["arm"], names["ended"].ys[0][-1])
    np.testing.assert_allclose(last[1], -1, atol=1e-8)
    shaken = names["shaken"].ys[0][-1] - fallen.q[-1]
    assert 1e-3 < np.abs(shaken).max() < 3
    motor = names["motor"]
    start = fj.State([-1.5, 0], [0, 0])
    whole = fj.simulate(names["arm"], start, [0.0, 1.0, 2.0], (motor,))
    np.testing.assert_allclose(names["whole"].q[100::100], whole.q[1:], atol=1e-9)
    assert names["whole"].outcome == "successful" and names["whole"].ts[-1] == 2
