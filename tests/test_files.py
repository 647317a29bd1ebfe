"""Files of JSON: what is saved is loaded."""

import contextlib
import dataclasses
import errno
import json
import os
import re
import stat
import struct
import threading
import traceback
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

import fdof_jax as fj
from fdof_jax.servo.drives import DriveState

SCENE, ARM = fj.scenes.fig7(), fj.scenes.fig5().linkage


# Classes of a user


class Push(eqx.Module):
    gain: Any
    name: str = eqx.field(static=True)

    def __call__(self, t, q, qd, linkage):
        return self.gain * jnp.cos(t) * jnp.ones(3)


class Explicit(fj.Element):
    """An element whose constructor has an argument that is no field."""

    twice: fj.Values = fj.field(unit="N m")

    def __init__(self, once):
        self.twice = 2 * once

    def arguments(self):
        return {"once": self.twice / 2}

    def __call__(self, t, q, qd, linkage):
        return self.twice


class Pair(NamedTuple):
    left: Any
    right: Any


@dataclasses.dataclass
class Plain:
    number: Any


OWN = elements.Swing, elements.Hold, Push, Explicit, Pair, Plain


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tree.json"


def bits(leaf):
    """Returns everything about a leaf that could have changed."""
    if isinstance(leaf, float):
        return float, struct.pack("d", leaf)
    if isinstance(leaf, jax.Array | np.ndarray):
        leaf = jax.device_put(leaf)
        return leaf.dtype, leaf.shape, leaf.weak_type, np.asarray(leaf).tobytes()
    return type(leaf), leaf


def same(a, b):
    """Checks that one tree may stand for the other, also in a compiled program."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    assert [*map(bits, jax.tree.leaves(a))] == [*map(bits, jax.tree.leaves(b))]


def saved_and_loaded(path, tree, classes=OWN):
    fj.save(path, tree)
    loaded = fj.load(path, classes)
    same(loaded, tree)
    return loaded


# What is saved and loaded


PENDULUM = """\
{
  "fdof_jax": "0.2",
  "Scene": {
    "linkage": {
      "Linkage": {
        "topology": "R",
        "length": [0.0, 1.0],
        "com": [[0.3333333333333333, 0.0]],
        "mass": [2.0],
        "inertia": [0.0],
        "locked": [0.0],
        "base_angle": 0.0,
        "gravity": 9.81
      }
    },
    "state0": {"State": {"q": [0.0], "qd": [-1e-300]}},
    "forces": [{"JointDamper": {"coefficient": 2.0}}],
    "t1": 10.0
  }
}
"""


def test_the_text_of_a_scene(path):
    arm = fj.Linkage("R", length=[0, 1], com=[[1 / 3, 0]], mass=[2], inertia=[0])
    start = fj.State(jnp.zeros(1), jnp.array([-1e-300]))
    saved_and_loaded(path, fj.Scene(arm, start, (fj.JointDamper(2),), 10.0))
    assert path.read_text() == PENDULUM
    fj.save(path, {"a": (np.nan, -np.inf), "b": "\u2202"})  # in strict JSON
    expected = {"dict": {"a": {"tuple": ["nan", "-inf"]}, "b": "\u2202"}}
    text = path.read_bytes().decode("ascii")
    assert "NaN" not in text and json.loads(text) == {"fdof_jax": "0.2", **expected}


def test_the_file_in_the_documentation(path):
    page = Path(__file__).parents[1] / "docs/api/data.md"
    path.write_text("\ufeff" + page.read_text().split("```")[1].removeprefix("json"))
    arm = fj.Linkage(
        "RP", length=[0, 1, 1], com=[[1, 0]] * 2, mass=[1, 2], inertia=[0] * 2
    )
    move = fj.references.JointMove([0.5, 0], [1, 0.2], fj.references.Travel(2))
    control = fj.PDController([1500, 800], 50, [np.inf, 300], move)
    start, damper = fj.State(jnp.array([0.5, 0.0]), jnp.zeros(2)), fj.JointDamper(2)
    others = dict(runs=3, gains=jnp.array([[1, 2], [3, 4]]), pair=(1.5, jnp.ones(2)))
    loaded = fj.load(path)
    same(loaded, dict(scene=fj.Scene(arm, start, (damper, control), 10), **others))
    assert [*loaded] == ["scene", "gains", "pair", "runs"]


MOVE = fj.references.JointMove(
    [0, 0, 0], [1, 2, 3], fj.references.Travel(2.0, profile="cycloidal")
)
LAPS = fj.references.Laps(2.0)
CURVES = {
    "line": fj.references.Line([0, 1], [2, 3]),
    "ellipse": fj.references.Ellipse([0, 1], [2, 3], tilt=0.1),
    "eight": fj.references.FigureEight([0, 1], [2, 3]),
    "spline": fj.references.Spline([[0, 0], [1, 0], [1, 1], [0, 1]], closed=True),
}
TREES = {
    "fig3": fj.scenes.fig3(),
    "fig7": SCENE,
    "eight joints": fj.Linkage(
        "RPFRRPFR", length=[1] * 9, com=[[1, 0]] * 8, mass=[1] * 8, inertia=[1] * 8
    ),
    **{name: (element,) for name, element in (elements.ALL | elements.HOLDING).items()},
    "prescribed": fj.simulation.PrescribedMotion((1, 3), MOVE),
    "model": fj.control.GravityFeedforward(1, 1, np.inf, fj.CircleTask(), ARM),
    **{
        name: fj.TipTask(curve, LAPS, orientation=None)
        for name, curve in CURVES.items()
    },
    "limits": fj.tuning.Limits(overshoot=0.05),
    "prices": fj.tuning.Tracking(effort=0.1),
    "state of a drive": DriveState(jnp.array([0.1]), ()),
    "own": Pair(Push(jnp.ones(3), "own"), Explicit(jnp.array([1.0, 2.0]))),
    "nested": {"b": (), "a": ({"": None}, ((1,), "x"), (2, None))},
    "text": 'a "\n\u2202\ud800',
}


@pytest.mark.parametrize("name", TREES)
def test_trees(name, path):
    tree = TREES[name]
    fj.save(path, jax.tree.map(jax.device_get, tree))  # in arrays of NumPy
    same(fj.load(path, OWN), tree)
    assert type(saved_and_loaded(path, tree)) is type(tree)
    assert os.listdir(path.parent) == [path.name]


def test_the_deepest_tree(path):
    tree = ("x",)
    for _ in range(99):
        tree = (tree,)
    saved_and_loaded(path, tree)
    with pytest.raises(ValueError, match="^tree: expected at most 100 levels"):
        fj.save(path, (tree,))


def test_states_of_any_shape(path):
    rows = jnp.arange(12.0).reshape(2, 2, 3) / 7
    scene = fj.Scene(ARM, fj.State(rows, rows), (fj.JointEffort(1.0),), 1.0)
    saved_and_loaded(path, scene)


arrays = st.builds(
    lambda entries, kind: jnp.array(entries, kind),
    st.lists(st.lists(st.integers(-9, 9), min_size=2, max_size=2), min_size=1),
    st.sampled_from([float, int, bool]),
)
trees = st.recursive(
    st.none() | st.booleans() | st.floats() | arrays
    | st.integers(-(2**63), 2**64 - 1)
    | st.text().filter(lambda text: text not in ("inf", "-inf", "nan")),
    lambda inner: (
        st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(), inner, max_size=3)
        | st.builds(Pair, inner, inner)
        | st.builds(Push, inner, st.text().filter(lambda text: "n" not in text))
    ),
    max_leaves=8,
)  # fmt: skip


@settings(
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(trees)
def test_any_tree(path, tree):
    fj.save(path, tree)
    loaded = fj.load(path, OWN)
    assert jax.tree.structure(loaded) == jax.tree.structure(tree)
    for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(tree)):
        assert bits(a) == bits(b) or a != a and b != b


@contextlib.contextmanager
def without_x64():
    jax.config.update("jax_enable_x64", False)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", True)


def test_numbers_are_exact(path):
    """Those in single precision too, wherever they are loaded."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal(999) * 10.0 ** rng.integers(-38, 38, 999)
    for kind in ("float64", "float32", "bfloat16"):
        saved = jnp.asarray(np.append(values, [-0.0, 5e-45, np.inf]), kind)
        fj.save(path, saved)
        exact = np.asarray(saved).astype(float)
        same(fj.load(path), exact)
        with without_x64():
            same(fj.load(path), exact.astype(np.float32))
    with without_x64():
        arm = fj.Linkage(
            "R", length=[0, 0.1], com=[[0.1, 0]], mass=[0.1], inertia=[1 / 3]
        )
        assert saved_and_loaded(path, arm).mass.dtype == np.float32
        saved_and_loaded(path, jnp.array([1, 2]))
    same(fj.load(path), jnp.array([1, 2]))


FIT = fj.FitResult(
    {"a": np.float64(1), "m": np.array([1.0, 2.0])}, {"a": np.inf, "m": np.ones(2)},
    ("a", "m[0]", "m[1]"), np.eye(3), (), 0.1, 1.5, True, "It stopped.", np.ones(4),
    (1.0, 1.1),
)  # fmt: skip


def test_results(path, tuned):
    for result in (tuned, FIT, {"PPR": tuned, "fit": FIT}):
        fj.save(path, result)
        loaded = fj.load(path)
        assert type(loaded) is type(result)
        assert isinstance(result, dict) or f"{loaded}" == f"{result}"
        pairs = zip(jax.tree.leaves(loaded), jax.tree.leaves(result), strict=True)
        for a, b in pairs:
            np.testing.assert_array_equal(a, b)
    assert loaded["PPR"].history.gains.shape == (2, 2, 3)
    assert loaded["fit"].usable == FIT.usable


# Paths, and files that appear whole or not at all


def test_a_replaced_file_keeps_permissions_and_links(path):
    link = path.with_name("link.json")
    link.symlink_to(path.name)
    fj.save(link, 1)  # to where the link points
    for mode in (0o600, 0o664):
        path.chmod(mode)
        fj.save(link, mode)
        assert link.is_symlink() and fj.load(path) == fj.load(f"{link}") == mode
        assert stat.S_IMODE(path.stat().st_mode) == mode
    assert sorted(os.listdir(path.parent)) == ["link.json", "tree.json"]


@pytest.mark.parametrize("name", ["x" * 255, "\U0001f600" * 63])
def test_the_longest_names(name, tmp_path):
    fj.save(tmp_path / name, 3)
    assert fj.load(tmp_path / name) == 3 and os.listdir(tmp_path) == [name]


def test_a_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    fj.save("~/tree.json", 3)
    assert fj.load(Path("~/tree.json")) == fj.load(tmp_path / "tree.json") == 3


PATHS = {
    "a path": [None, 3, ["a"], b"a", "", "a\0b"],
    "a path on this machine, no address": ["s3://bucket/x", Path("gs://bucket/x")],
    "a path in a home that exists": ["~nobody-at-all/x"],
    "the path of a file, not of a folder": [".", "f", "f/", Path("to f")],
    "the path of a file, not of a pipe or a device": ["pipe", "/dev/null", "to pipe"],
}


def test_other_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkdir("f")
    os.mkfifo("pipe")
    for name in ("f", "pipe"):
        os.symlink(name, f"to {name}")
    os.symlink("loop", "loop")
    for expected, value in ((words, v) for words, row in PATHS.items() for v in row):
        for call in (partial(fj.save, tree=1), fj.load):
            with pytest.raises(ValueError, match=f"^path: expected {expected}, got "):
                call(value)
    for call, name, kind in (
        (fj.load, "none", FileNotFoundError),
        (fj.load, "loop", OSError),
        (partial(fj.save, tree=1), "none/none", FileNotFoundError),
        (partial(fj.save, tree=1), "loop", OSError),
    ):
        with pytest.raises(kind):
            call(name)
    assert len(os.listdir()) == 5


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_full_disk_names_the_path_and_leaves_the_older_file(name, path, monkeypatch):
    fj.save(path, SCENE)
    before = path.read_bytes()

    def full(*arguments, **keywords):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, name, full)
    with pytest.raises(OSError, match=re.escape(str(path))) as raised:
        fj.save(path, fj.scenes.fig3())
    assert raised.value.errno == errno.ENOSPC
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_two_writers_of_one_file_do_not_meet(path, monkeypatch):
    both = threading.Barrier(2, timeout=60)  # both files are open at once
    monkeypatch.setattr(os, "fsync", lambda number: both.wait())
    texts = "one" * 1000, "two" * 1000
    writers = [threading.Thread(target=fj.save, args=(path, text)) for text in texts]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [*path.parent.iterdir()] == [path] and fj.load(path) in texts


class Positive(eqx.Module):
    number: float

    def __check_init__(self):
        if self.number <= 0:
            raise ValueError("must be positive")


def test_a_class_may_be_given_twice_and_says_what_it_refuses(path):
    fj.save(path, Positive(2.0))
    assert fj.load(path, (Positive, Positive)).number == 2
    path.write_text(path.read_text().replace("2.0", "-2.0"))
    with pytest.raises(ValueError, match="json: tree: must be positive") as caught:
        fj.load(path, (Positive,))
    assert "in __check_init__" in "".join(traceback.format_exception(caught.value))
