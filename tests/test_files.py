"""Files of JSON: what is saved is loaded, and no damaged file is taken for another.

What cannot be saved, and files that cannot be read, are in refusals.py.
"""

import contextlib
import errno
import functools
import os
import re
import stat
import struct
import sys
import threading
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from refusals import AT, element, of

import fdof_jax as fj

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


OWN = elements.Swing, elements.Hold, Push, Explicit, Pair


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
    for one, other in zip(*map(jax.tree.leaves, (a, b))):
        assert bits(one) == bits(other) or one != one and other != other


# What is saved and loaded

TEXT = """\
{
  "fdof_jax": "0.2",
  "dict": {
    "a": [
      {"State": {"q": [0.0], "qd": [-1e-300]}},
      {"JointDamper": {"coefficient": 2.0}}
    ],
    "b": {"tuple": ["nan", "\\u2202"]}
  }
}
"""


def test_the_text_of_a_file(path):
    start = fj.State(jnp.zeros(1), jnp.array([-1e-300]))
    fj.save(path, {"a": (start, fj.JointDamper(2)), "b": (np.nan, "\u2202")})
    assert path.read_bytes().decode("ascii") == TEXT


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


FIT = fj.FitResult(
    {"a": np.float64(1), "m": np.array([1.0, 2.0])}, {"a": np.inf, "m": np.ones(2)},
    ("a", "m[0]", "m[1]"), np.eye(3), (), 0.1, 1.5, True, "It stopped.", np.ones(4),
    (1.0, 1.1),
)  # fmt: skip
DEEPEST = functools.reduce(lambda tree, _: (tree,), range(99), ("x",))
TREES = {
    "fig7": SCENE,
    **{name: (element,) for name, element in (elements.ALL | elements.HOLDING).items()},
    "model": fj.control.GravityFeedforward(1, 1, np.inf, fj.CircleTask(), ARM),
    "spline": fj.references.Spline([[0, 0], [1, 0], [1, 1], [0, 1]], closed=True),
    "own": Pair(Push(jnp.ones(3), "own"), Explicit(jnp.array([1.0, 2.0]))),
    "deepest": DEEPEST,
}


@pytest.mark.parametrize("name", TREES)
def test_trees(name, path):
    tree = TREES[name]
    for saved in tree, jax.tree.map(jax.device_get, tree):  # in arrays of NumPy
        fj.save(path, saved)
        same(fj.load(path, OWN), tree)
    assert os.listdir(path.parent) == [path.name]


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


PATH_AGAIN = [HealthCheck.function_scoped_fixture]


@settings(max_examples=50, deadline=None, suppress_health_check=PATH_AGAIN)
@given(trees)
def test_any_tree(path, tree):
    fj.save(path, tree)
    same(fj.load(path, OWN), tree)


def test_numbers_are_exact(path):
    """Those in single precision too, wherever they are loaded."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal(999) * 10.0 ** rng.integers(-38, 38, 999)
    for kind in ("float64", "float32", "bfloat16"):
        saved = jnp.asarray(np.append(values, [-0.0, 5e-45, np.inf]), kind)
        fj.save(path, saved)
        exact = np.asarray(saved).astype(float)
        same(fj.load(path), exact)
        with jax.enable_x64(False):
            same(fj.load(path), exact.astype(np.float32))


def test_results(path, tuned):
    result = {"PPR": tuned, "fit": FIT}
    fj.save(path, result)
    loaded = fj.load(path)
    assert [f"{value}" for value in loaded.values()] == [f"{tuned}", f"{FIT}"]
    for a, b in zip(*map(jax.tree.leaves, (loaded, result)), strict=True):
        np.testing.assert_array_equal(a, b)


# Classes that files name


OTHERS = """os.system eval object Solution Args Frozen Any drawing forces.JointDamper
__class__ History.__class__ LoopedDopri8 Unheard jointdamper""".split()


def refused(path, words, classes=OWN):
    """Checks that the error message names the file and the fault."""
    with pytest.raises(ValueError, match=rf"(?s)^{path}: .*{words}.*\.$"):
        fj.load(path, classes)


def test_no_other_class_is_made_but_those_of_a_user(path):
    pictures = "fdof_jax.pictures.drawing" in sys.modules
    words = f"{AT}: expected a class of fdof_jax, or one of load"
    for name in OTHERS:
        path.write_text(element(name, '{"command": "touch made"}'))
        refused(path, f"{words}.*got '{name}'")
    assert pictures == ("fdof_jax.pictures.drawing" in sys.modules)
    fj.save(path, (Push(1.0, "a"),))
    for classes in ((), (Pair,), (Push, type("Push", (), {}))):
        refused(path, r"tree\[0\]: .*classes=\(MyElement,\).*got 'Push'", classes)
    assert eqx.tree_equal(fj.load(path, [Push, Push]), (Push(1.0, "a"),))
    for value in (Push, "Push", (3,), (Push(1.0, "a"),), None):
        with pytest.raises(ValueError, match="^classes: expected a tuple of classes"):
            fj.load(path, value)


# Paths, and files that appear whole or not at all


def test_a_replaced_file_keeps_permissions_and_links(path):
    link = path.with_name("link.json")
    link.symlink_to(path.name)
    path.touch(0o600)
    fj.save(link, 1)  # to where the link points
    assert link.is_symlink() and fj.load(path) == fj.load(f"{link}") == 1
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert sorted(os.listdir(path.parent)) == ["link.json", "tree.json"]


PATHS = {
    "a path": [None, 3, b"a", "", "a\0b"],
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
    save = functools.partial(fj.save, tree=1)
    for expected, value in ((words, v) for words, row in PATHS.items() for v in row):
        for call in (save, fj.load):
            with pytest.raises(ValueError, match=f"^path: expected {expected}, got "):
                call(value)
    for call in (fj.load, save):
        with pytest.raises(FileNotFoundError):
            call("none/none")
    assert len(os.listdir()) == 4
    for name in ("x" * 255, "\U0001f600" * 63):  # the longest
        fj.save(name, 3)
        assert fj.load(name) == 3
    monkeypatch.setenv("HOME", str(tmp_path))
    fj.save("~/tree.json", 3)
    assert fj.load(Path("~/tree.json")) == fj.load(tmp_path / "tree.json") == 3


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_full_disk_names_the_path_and_leaves_the_older_file(name, path, monkeypatch):
    fj.save(path, SCENE)
    before = path.read_bytes()

    def full(*arguments, **keywords):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, name, full)
        with pytest.raises(OSError, match=re.escape(str(path))) as raised:
            fj.save(path, fj.scenes.fig3())
    assert raised.value.errno == errno.ENOSPC
    with pytest.raises(ValueError, match="^tree: expected"):
        fj.save(path, object())
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_two_writers_of_one_file_do_not_meet(path, monkeypatch):
    both = threading.Barrier(2, timeout=60)  # both files are open at once
    monkeypatch.setattr(os, "fsync", lambda number: both.wait())
    texts = "one" * 1000, "two" * 1000
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(functools.partial(fj.save, path), texts))
    assert [*path.parent.iterdir()] == [path] and fj.load(path) in texts


# Files that are damaged or large


def test_a_file_cut_or_changed_anywhere(path):
    """A change that is no error is another file as a person might have written it."""
    fj.save(path, fj.PDController([1, 2, 3], 0.5, np.inf, fj.CircleTask()))
    content = path.read_bytes()
    cuts = [content[:length] for length in range(len(content) - 1)]
    flips = [content[:i] + bytes([content[i] ^ flip]) + content[i + 1 :]
             for i in range(len(content)) for flip in (0x01, 0xFF)]  # fmt: skip
    for case, damaged in enumerate(cuts + flips):
        path.write_bytes(damaged)
        try:
            fj.load(path)
        except ValueError as error:
            assert str(error).startswith(f"{path}: ")
        else:
            assert case >= len(cuts)


@pytest.mark.slow
def test_the_memory_is_bounded_by_the_size(path):
    numbers = ", ".join(["[1.5, 2]"] * 20_000)
    for value in ('["x"' + ',{"dict":{}}' * 9_000 + "]", f"[{numbers}, 1]"):
        path.write_text(of(f'"value": {value}'))
        tracemalloc.start()
        with contextlib.suppress(ValueError):  # the second one is no rectangle
            fj.load(path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < 60 * path.stat().st_size + 2e6
