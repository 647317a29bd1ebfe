"""Files of JSON: what is saved is loaded, and all else is refused by name and place."""

import contextlib
import dataclasses
import json
import os
import stat
import struct
import sys
import tracemalloc
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
from fdof_jax.control.drives import DriveState
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

SCENE, ARM = fj.scenes.fig7(), fj.scenes.fig5().linkage


# Classes of a user


class Push(eqx.Module):
    gain: Any
    name: str = eqx.field(static=True)

    def __call__(self, t, q, qd, linkage):
        return self.gain * jnp.cos(t) * jnp.ones(3)


class Half(fj.Element):
    """An element whose constructor has an argument that is no field."""

    twice: fj.Values = fj.field(unit="N m")

    def __init__(self, once):
        self.twice = 2 * once

    def __call__(self, t, q, qd, linkage):
        return self.twice


class Explicit(Half):
    def arguments(self):
        return {"once": self.twice / 2}


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
    **{name: (element,) for name, element in elements.ALL.items()},
    "prescribed": fj.simulation.PrescribedMotion((1, 3), MOVE),
    "model": fj.control.GravityFeedforward(1, 1, np.inf, fj.CircleTask(), ARM),
    **{
        name: fj.TipTask(curve, fj.references.Laps(2.0), orientation=None)
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
    assert type(saved_and_loaded(path, TREES[name])) is type(TREES[name])
    assert os.listdir(path.parent) == [path.name]


def stack(*trees):
    return jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows)), *trees)


@pytest.mark.parametrize("name", [*elements.ALL, "prescribed", "model", "spline"])
def test_batches(name, path):
    """Arrays of a batch have a leading axis, those of a batch of batches two."""
    tree = TREES[name]
    pair = stack(tree, jax.tree.map(lambda a: jnp.asarray(np.array(a)), tree))
    saved_and_loaded(path, pair)
    saved_and_loaded(path, stack(pair, pair, pair))


def test_batches_of_scenes_and_of_numbers(path):
    arms = stack(ARM, ARM.replace(mass=[1, 2, 3]))
    rows = jnp.arange(12.0).reshape(2, 2, 3) / 7
    scene = fj.Scene(ARM, fj.State(rows, rows), (fj.JointEffort(1.0),), 1.0)
    saved_and_loaded(path, scene)
    saved_and_loaded(path, fj.Scene(arms, fj.State(rows[0], rows[1]), (), rows[0, 0]))
    saved_and_loaded(path, fj.Linkage.replace(ARM, base_angle=0.3))


def test_a_member_of_a_batch_is_checked(path):
    fj.save(path, stack(fj.CircleTask(), fj.CircleTask(radius=0.625)))
    path.write_text(path.read_text().replace("0.625", "-1"))
    refused(path, r"tree\[1\]\.radius: expected .* at least 0")


arrays = st.builds(
    lambda entries, kind: jnp.array(entries, kind),
    st.lists(st.lists(st.integers(-9, 9), min_size=2, max_size=2), min_size=1),
    st.sampled_from([float, int, bool]),
)
trees = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | arrays
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


@pytest.mark.parametrize("kind", ["float64", "float32", "bfloat16"])
def test_numbers_are_exact(kind, path):
    """Those in single precision too, wherever they are loaded."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal(999) * 10.0 ** rng.integers(-38, 38, 999)
    saved = jnp.asarray(np.append(values, [-0.0, 5e-45, np.inf]), kind)
    fj.save(path, saved)
    exact = np.asarray(saved).astype(float)
    same(fj.load(path), exact)
    with without_x64():
        same(fj.load(path), exact.astype(np.float32))
        integers = jnp.array([1, 2])
        saved_and_loaded(path, integers)
    same(fj.load(path), jnp.array([1, 2]))


def test_single_precision_throughout(path):
    with without_x64():
        arm = fj.Linkage(
            "R", length=[0, 0.1], com=[[0.1, 0]], mass=[0.1], inertia=[1 / 3]
        )
        loaded = saved_and_loaded(path, arm)
        assert loaded.mass.dtype == np.float32


FIT = fj.FitResult(
    {"a": np.float64(1), "m": np.array([1.0, 2.0])}, {"a": np.inf, "m": np.ones(2)},
    ("a", "m[0]", "m[1]"), np.eye(3), (), 0.1, 1.5, True, "It stopped.", np.ones(4),
    (1.0, 1.1),
)  # fmt: skip


def test_results(path, tuned):
    trade = fj.tuning.TradeOff(*np.ones((3, 1)), [tuned])
    for result in (tuned, FIT, trade, {"PPR": tuned, "fit": FIT}):
        fj.save(path, result)
        loaded = fj.load(path)
        assert type(loaded) is type(result)
        assert isinstance(result, dict) or f"{loaded}" == f"{result}"
        pairs = zip(jax.tree.leaves(loaded), jax.tree.leaves(result), strict=True)
        for a, b in pairs:
            np.testing.assert_array_equal(a, b)
    assert loaded["PPR"].history.gains.shape == (2, 2, 3)
    assert loaded["fit"].usable == FIT.usable


def test_a_loaded_scene_compiles_nothing(path):
    calls = []

    @eqx.filter_jit
    def efforts(scene):
        calls.append(1)
        return scene.forces[0](0.0, *scene.state0, scene.linkage)

    loaded = saved_and_loaded(path, SCENE)
    np.testing.assert_array_equal(efforts(SCENE), efforts(loaded))
    assert len(calls) == 1


# What cannot be saved


def cyclic():
    items = []
    items.append(items)
    return items


deleted = jnp.ones(3) + 1
deleted.delete()
TS = np.linspace(0, 1, 3)
MOTION = fj.Solution(TS, np.ones((3, 3)), np.ones((3, 3)), {}, None)
ALIKE = type("JointDamper", (eqx.Module,), {})()
UNSAVED = {
    "lambda": (lambda t, linkage: (t, t), "equinox.Module .* got <function"),
    "function": (fj.simulate, "equinox.Module .* got <function simulate"),
    "method": (Push(1.0, "").__call__, "bound method"),
    "class": (Push, "class .*Push"),
    "object": (object(), "object"),
    "bytes": (b"abc", "b'abc'"),
    "keys": ({1: 2}, r"dicts by text, .* got \{1: 2\}"),
    "the text of a number": ("inf", "'inf'"),
    "complex": (np.array([1j]), "real numbers"),
    "objects": (np.array([None]), "real numbers"),
    "texts": (np.array(["a"]), "real numbers"),
    "structured": (np.zeros(2, [("a", "f8")]), "real numbers"),
    "masked": (np.ma.zeros(2), "real numbers.*masked"),
    "empty": (np.zeros((0, 3)), "at least one"),
    "deleted": (deleted, "real numbers"),
    "random key": (jax.random.key(3), "real numbers"),
    "motion": (MOTION, "to_xarray .* got Solution"),
    "class within the library": (LoopedDopri8(), "public class, .*LoopedDopri8"),
    "class of a public name": (ALIKE, "another name, .*JointDamper"),
    "constructor unknown": (Half(1.0), "a method `arguments`.* once"),
    "impossible": (eqx.tree_at(lambda a: a.mass, ARM, -ARM.mass), "mass: .* at least"),
    "partly a batch": (
        eqx.tree_at(lambda a: a.mass, ARM, jnp.ones((9, 3))), "batch .*; mass: .*9, 3",
    ),
    "without a value": (object.__new__(Plain), "number"),
}  # fmt: skip


@pytest.mark.parametrize("name", UNSAVED)
def test_what_cannot_be_saved(name, path):
    value, words = UNSAVED[name]
    fj.save(path, "older")
    before = path.read_bytes()
    place = r"tree\.forces\[1\]\.reference"
    holder = Pair(1.0, value)
    if callable(value) and not isinstance(value, type):
        holder = fj.PDController(1, 1, 1, value)
    else:
        place = r"tree\.forces\[1\]\.right"
    scene = SCENE._replace(forces=(fj.JointDamper(1.0), holder))
    with pytest.raises(ValueError, match=rf"(?s)^{place}: expected .*{words}.*\.$"):
        fj.save(path, scene)
    with pytest.raises(ValueError, match=r"^tree\['a'\]\[0\]\['b'\]: expected"):
        fj.save(path, {"a": [{"b": value}]})
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_a_tree_without_end_cannot_be_saved(path):
    with pytest.raises(ValueError, match="^tree: expected .*without end"):
        fj.save(path, cyclic())


def test_a_traced_value_cannot_be_saved(path):
    scene = lambda x: SCENE._replace(forces=(fj.JointDamper(x),))
    place = r"tree\.forces\[0\]\.coefficient"
    with pytest.raises(ValueError, match=rf"^{place}: expected .*outside of jit"):
        jax.jit(lambda x: fj.save(path, scene(x)))(1.0)
    assert not path.exists()


# What cannot be loaded


def refused(path, words, classes=OWN):
    """Checks that the error message names the file and the fault."""
    with pytest.raises(ValueError, match=rf"(?s)^{path}: .*{words}.*\.$"):
        fj.load(path, classes)


def of(text):
    return f'{{"fdof_jax": "0.2", {text}}}'


def element(name, arguments):
    return of(f'"value": ["x", {{"{name}": {arguments}}}]')


AT = r"tree\[1\]"
UNREADABLE = {
    # No JSON, or that of other programs
    "": "expected JSON, got .*line 1",
    "q,qd\n1,2\n": "expected JSON",
    of('"value": 1') + "{}": "expected JSON, got Extra data",
    of('"value": NaN'): 'expected JSON, got NaN, which is no number \\("inf"',
    of('"value": -Infinity'): "expected JSON, got -Infinity",
    of('"value": 1e999'): "expected JSON, got 1e999",
    of(f'"value": {"9" * 5000}'): "expected JSON, got .*4300 digits",
    of('"dict": {"a": 1, "a": 2}'): "name twice in one object, of .*'a', 'a'",
    "[" * 100_000: "expected less nesting",
    '{"a":' * 100_000: "expected less nesting",
    "[]": "version of the library, .* got None",
    '{"asset": {"version": "2.0"}}': "version of the library, .* got None",
    '{"fdof_jax": 0.2, "value": 1}': "version of the library, .* got 0.2",
    '{"fdof_jax": "new", "value": 1}': "version of the library, .* got 'new'",
    '{"fdof_jax": "0.99.1", "Unheard": {}}': "or an older version, got '0.99.1'",
    '{"fdof_jax": "7.0", "value": 1}': "or an older version, got '7.0'",
    # Objects
    '{"fdof_jax": "0.2"}': r"tree: expected an object by its name alone, got \[\]",
    of('"State": {}, "Scene": {}'): r"its name alone, got \['State', 'Scene'\]",
    of('"value": {"value": 1}'): "tree.value: expected named arguments, got 1",
    of('"value": 1, "Scene": {}'): r"its name alone, got \['value', 'Scene'\]",
    of('"tuple": {}'): "tree: expected a class of .*got 'tuple'",
    of('"batch": []'): "tree: expected a list of scenes",
    of('"batch": [{"JointDamper": {"coefficient": 1}}, {"Point": {"link": 1}}]'): (
        r"tree\[1\]: expected one like tree\[0\]"
    ),
    element("JointDamper", "[1]"): rf"{AT}.JointDamper: expected named .* got \[1\]",
    element("JointDamper", "{}"): f"{AT}: expected the arguments .*'coefficient'",
    element("JointDamper", '{"gain": 1}'): f"{AT}: expected the arguments .*'gain'",
    element("State", '{"q": [1]}'): f"{AT}: expected the arguments of State.*'qd'",
    element("JointDamper", '{"coefficient": -1}'): f"{AT}.coefficient: .*at least 0",
    element("JointDamper", '{"coefficient": "nan"}'): f"{AT}.coefficient: .*got nan",
    element("JointDamper", '{"coefficient": "1"}'): f"{AT}.coefficient: .*got '1'",
    element("JointDamper", '{"coefficient": true}'): f"{AT}.coefficient: .*got True",
    element("JointDamper", '{"coefficient": null}'): f"{AT}.coefficient: .*got None",
    element("JointStops", '{"lower": 1, "upper": 0}'): f"{AT}.lower: .*less than upper",
    element("PDController", '{"kp": 1, "kd": 1, "limit": 1, "reference": 3}'): (
        f"{AT}.reference: expected a callable"
    ),
    element("Wrench", '{"point": {"Point": {"link": 9}}}'): f"{AT}.point.link: .*got 9",
    element("SpringDamper", '{"a": 1, "b": 2}'): f"{AT}.a: expected a Point",
    element("Travel", '{"duration": 1, "profile": "os"}'): f"{AT}.profile: .*got 'os'",
    element("PrescribedMotion", '{"joints": [1.5], "reference": 3}'): f"{AT}.joints: ",
    element("Element", "{}"): f"{AT}: expected the arguments .*abstract",
    # Arrays
    of('"value": [1, [2]]'): "tree: expected numbers in lists of one length",
    of('"value": [[1, 2], [3]]'): "tree: expected numbers in lists of one length",
    of('"value": [1, "x"]'): r"tree: expected numbers .*got \[1, 'x'\]",
    of('"value": [1, null]'): r"tree: expected numbers .*got \[1, None\]",
    of(f'"value": [1, {2**70}]'): "tree: expected numbers",
    of('"value": ["x", [1, {"Scene": {}}]]'): rf"{AT}: expected numbers",
    of(f'"value": {"[" * 99}1{"]" * 99}'): "tree: expected numbers",
}


@pytest.mark.parametrize("text", UNREADABLE, ids=lambda text: text[:60])
def test_what_cannot_be_loaded(text, path):
    path.write_text(text)
    refused(path, UNREADABLE[text])


def test_an_archive_cannot_be_loaded(path):
    with path.open("wb") as file:
        np.savez(file, q=np.ones(3))
    refused(path, "expected JSON, got 'utf-8'")


OTHERS = """os.system os:system subprocess.Popen eval object Solution SampledMotion Args
Frozen Values Any Array fdof_jax drawing forces.JointDamper __class__ History.__class__
LoopedDopri8 Unheard jointdamper""".split()


@pytest.mark.parametrize("name", OTHERS)
def test_no_other_class_is_made(name, path):
    path.write_text(element(name, '{"command": "touch made"}'))
    pictures = "fdof_jax.pictures.drawing" in sys.modules
    refused(path, f"{AT}: expected a class of fdof_jax, or one of load.*got '{name}'")
    assert pictures == ("fdof_jax.pictures.drawing" in sys.modules)


def test_classes_of_a_user(path):
    fj.save(path, (Push(1.0, "a"),))
    for classes in ((), (Pair,), (Push, type("Push", (), {}))):
        refused(path, r"tree\[0\]: .*classes=\(MyElement,\).*got 'Push'", classes)
    assert eqx.tree_equal(fj.load(path, [Push]), (Push(1.0, "a"),))
    for value in (Push, "Push", (3,), None):
        with pytest.raises(ValueError, match="^classes: expected a tuple of classes"):
            fj.load(path, value)


def test_a_file_cut_or_changed_anywhere(path):
    """What is no error is another file as a person might have written it."""
    fj.save(path, fj.PDController([1, 2, 3], 0.5, np.inf, fj.CircleTask()))
    content = path.read_bytes()
    cuts = [content[:length] for length in range(len(content) - 1)]
    flips = [content[:i] + bytes([content[i] ^ flip]) + content[i + 1 :]
             for i in range(len(content)) for flip in (0x01, 0x10, 0xFF)]  # fmt: skip
    for case, damaged in enumerate(cuts + flips):
        path.write_bytes(damaged)
        try:
            fj.load(path)
        except ValueError as error:
            assert str(error).startswith(f"{path}: ")
        else:
            assert case >= len(cuts)


NUMBERS = ", ".join(["[1.5, 2]"] * 20_000)
LARGE = {
    "lists": "[" + "[]," * 20_000 + "0]",
    "dicts": '["x"' + ',{"dict":{}}' * 9_000 + "]",
    "a long text among numbers": "[" + "1," * 50_000 + f'"{"x" * 100_000}"]',
    "wide letters": '"' + "x" * 200_000 + '\U0001f600"',
    "a rectangle but for its end": f"[{NUMBERS}, 1]",
    "numbers": f"[{NUMBERS}]",
    "spline": f'{{"Spline": {{"points": [{NUMBERS}]}}}}',
    "history": f'{{"EffortHistory": {{"ts": [{NUMBERS}], "tau": [{NUMBERS}]}}}}',
    "names": f'{{"{"x" * 200_000}": {{}}}}',
}


@pytest.mark.parametrize("name", LARGE)
def test_the_memory_is_bounded_by_the_size(name, path):
    path.write_text(of(f'"value": {LARGE[name]}'))
    tracemalloc.start()
    with contextlib.suppress(ValueError):
        fj.load(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 60 * path.stat().st_size + 2e6


@pytest.mark.parametrize("kind", [RuntimeError, MemoryError, OSError])
def test_other_failures_are_raised_as_they_are(kind, path, monkeypatch):
    fj.save(path, jnp.zeros(4))

    def failing(*arguments):
        raise kind("no device")

    monkeypatch.setattr(jax, "device_put", failing)
    with pytest.raises(kind, match="^no device$"):
        fj.load(path)


# Paths


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


def test_a_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    fj.save("~/tree.json", 3)
    assert fj.load(Path("~/tree.json")) == fj.load(tmp_path / "tree.json") == 3


PATHS = {
    "a path": [None, 3, ["a"], b"a", "", "a\0b"],
    "a path on this machine, no address": ["s3://bucket/x", Path("gs://bucket/x")],
    "a path in a home that exists": ["~nobody-at-all/x"],
    "the path of a file, not of a folder": [
        ".",
        "folder",
        "folder/",
        Path("to folder"),
    ],
    "the path of a file, not of a pipe or a device": ["pipe", "/dev/null", "to pipe"],
}


@pytest.mark.parametrize("expected", PATHS)
def test_other_paths(expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkdir("folder")
    os.mkfifo("pipe")
    os.symlink("folder", "to folder")
    os.symlink("pipe", "to pipe")
    for value in PATHS[expected]:
        for call in (partial(fj.save, tree=1), fj.load):
            with pytest.raises(ValueError, match=f"^path: expected {expected}, got "):
                call(value)
    assert len(os.listdir()) == 4


def test_missing_files(path):
    os.symlink("loop", path.with_name("loop"))
    for name, kind in (("none", FileNotFoundError), ("loop", OSError)):
        with pytest.raises(kind):
            fj.load(path.with_name(name))
    for place, kind in (("none/none", FileNotFoundError), ("loop", OSError)):
        with pytest.raises(kind):
            fj.save(path.parent / place, 1)
    assert os.listdir(path.parent) == ["loop"]


def test_a_failed_save_leaves_the_older_file(path, monkeypatch):
    fj.save(path, SCENE)
    before = path.read_bytes()
    for name in ("fsync", "replace"):

        def full(*arguments, **keywords):
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            with pytest.raises(OSError, match="No space left"):
                fj.save(path, fj.scenes.fig3())
        assert path.read_bytes() == before
        assert os.listdir(path.parent) == [path.name]


def test_the_file_is_strict_json(path):
    fj.save(path, {"a": (np.nan, -np.inf), "b": "\u2202"})

    def constant(name):
        raise AssertionError(name)

    expected = {"dict": {"a": {"tuple": ["nan", "-inf"]}, "b": "\u2202"}}
    file = json.loads(path.read_bytes().decode("ascii"), parse_constant=constant)
    assert file == {"fdof_jax": "0.2", **expected}
