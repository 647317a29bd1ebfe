"""Saved trees are loaded unchanged."""

import dataclasses
import os
import re
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import diffrax
import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from saved_trees import (
    OWN,
    SCENES,
    Colour,
    Nothing,
    Pair,
    Plain,
    Push,
    describe,
    refused,
    same,
    saved_and_loaded,
)

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.shell.tuning_run import Job
from fdof_jax.simulation import prescribed
from fdof_jax.simulation.looped_dopri8 import LoopedDopri8
from fdof_jax.tuning import tuning

TS = np.linspace(0, 0.1, 4)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tree.fdof"


# Trees that are saved and loaded


@pytest.mark.parametrize("name", SCENES)
def test_scenes(name, path):
    scene = saved_and_loaded(path, SCENES[name])
    assert type(scene) is fj.Scene
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.parametrize("name", elements.ALL)
def test_elements(name, path):
    loaded = saved_and_loaded(path, (elements.ALL[name],), OWN)
    assert type(loaded[0]) is type(elements.ALL[name])


REFERENCES = {
    "move": fj.references.JointMove(
        [0, 0, 0], [1, 2, 3], fj.references.Travel(2.0, profile="cycloidal")
    ),
    "line": fj.TipTask(
        fj.references.Line([0, 1], [2, 3]), fj.references.Laps(2.0), orientation=0.1
    ),
    "spline": fj.TipTask(
        fj.references.Spline([[0, 0], [1, 0], [1, 1], [0, 1]], closed=True),
        fj.references.Travel(1.0),
    ),
}


@pytest.mark.parametrize("name", REFERENCES)
def test_references_with_static_fields(name, path):
    saved_and_loaded(path, fj.PrescribedMotion((1, 3), REFERENCES[name]))


@pytest.fixture(scope="module")
def solved():
    """Returns a call of `simulate` and its solution."""
    scene = scenes.fig7()
    ts, forces = np.linspace(0, 0.1, 13), (elements.WITH_STATE["PID"],)
    call = scene.linkage, scene.state0, ts, forces
    return call, fj.simulate(*call)


def test_a_solution(path, solved):
    loaded = saved_and_loaded(path, solved[1])
    assert loaded.outcome == "successful"
    assert loaded.result == diffrax.RESULTS.successful
    assert loaded.own[0].shape == (13, 3)
    # The elements' states, from which a motion can continue
    saved_and_loaded(path, {"own0": (loaded.own[0][-1],)})


def test_a_batch_of_which_one_failed(path):
    linkage, (q, qd), _, _ = scenes.fig5()
    starts = fj.State(np.stack([q, q + 0.1]), np.stack([qd, [np.nan, 0, 0]]))
    options = dict(solver=LoopedDopri8(), throw=False)  # compiled soon
    solution = jax.vmap(lambda s: fj.simulate(linkage, s, TS, **options))(starts)
    loaded = saved_and_loaded(path, solution)
    assert loaded.outcome.tolist() == ["successful", "not finite"]
    assert (loaded.result == diffrax.RESULTS.successful).tolist() == [True, False]


@pytest.mark.slow
def test_a_tuned_scene(path):
    tuned = fj.tune(scenes.fig7()._replace(t1=0.2), max_steps=1)
    loaded = saved_and_loaded(path, tuned)
    assert type(loaded) is fj.TuneResult and loaded.message == tuned.message


def test_all_fields_of_a_tuned_scene(path):
    """Uses stand-ins for the results that the slow test computes."""
    tuned = object.__new__(fj.TuneResult)
    for field in dataclasses.fields(tuned):
        object.__setattr__(tuned, field.name, {field.name: np.ones(2)})
    saved_and_loaded(path, eqx.tree_at(lambda t: t.scene, tuned, SCENES["fig7"]))


def test_a_loaded_scene_simulates_the_same_without_a_compilation(
    path, solved, monkeypatch
):
    calls = []
    original = prescribed.vector_field

    def counted(*arguments):
        calls.append(1)
        return original(*arguments)

    monkeypatch.setattr(prescribed, "vector_field", counted)
    call, solution = solved
    loaded = saved_and_loaded(path, call, OWN)
    same(fj.simulate(*loaded), solution)
    assert not calls
    linkage, state0, *_ = call
    ts = np.linspace(0, 0.1, 4003)  # as many as in no other test
    jax.eval_shape(lambda q: fj.simulate(linkage, fj.State(q, q), ts), state0.q)
    assert calls


def test_a_loaded_solution_compiles_nothing(path, solved):
    """Step counts have a weak type; JAX compiles anew if that type changes."""
    calls = []
    steps = jax.jit(lambda s: (calls.append(1), s.stats["num_steps"])[1])
    steps(solved[1])
    steps(saved_and_loaded(path, solved[1]))
    assert len(calls) == 1


LEAVES = {
    "-0": -0.0,
    "inf": np.inf,
    "nan": float("nan"),
    "minus nan": struct.unpack("d", struct.pack("d", np.nan)[:-1] + b"\xff")[0],
    "whole": 3,
    "large": 2**70,
    "bool": True,
    "none": None,
    "text": 'a "\n\u2202\ud800',
    "no array": np.zeros((0, 3)),
    "NumPy scalar": np.float32(0.1),
    "NumPy float": np.float64(0.1),
    "NumPy text": np.array(["a", "bc"]),
    "big-endian": np.arange(3, dtype=">f8"),
    "columns first": np.arange(6.0).reshape(2, 3).T,
    "strided": np.arange(6)[::2],
    "complex": np.array([1j, np.nan]),
    "JAX bool": jnp.array([True, False]),
    "float32": jnp.array([0.1, -0.0, np.nan, np.inf], dtype=np.float32),
    "bfloat16": jnp.arange(3, dtype=jnp.bfloat16),
    "int4": jnp.arange(3, dtype=jnp.int4),
    "uint64": jnp.array(2**64 - 1, dtype=np.uint64),
    "weak": jnp.asarray(0.5),
    "weak array": jnp.broadcast_to(jnp.asarray(7), (2, 1)),
    "random key": jax.random.key(3),
    "random keys": jax.random.split(jax.random.key(3, impl="rbg"), 2),
    "function": tuning.tip_errors,
    "result": diffrax.RESULTS.singular,
    "own result": Colour.green,
    "nested": {"b": [(), [], {}], "a": ({"": None}, [(1,), Nothing()])},
    "own tuple": Pair(left=(1, 2), right=Pair(None, [3])),
}


@pytest.mark.parametrize("name", LEAVES)
def test_leaves(name, path):
    saved_and_loaded(path, LEAVES[name], OWN)
    saved_and_loaded(path, fj.Scene(*[LEAVES[name]] * 4), OWN)


def test_a_plain_dataclass(path):
    fj.save(path, [Plain(3)])
    assert fj.load(path, OWN) == [Plain(3)]


arrays = st.builds(
    lambda entries, kind, jaxed: (jnp.array if jaxed else np.array)(entries, kind),
    st.lists(st.integers(0, 100), max_size=3),
    st.sampled_from(["f8", "f4", "i8", "u1", "c16", "?"]),
    st.booleans(),
)
trees = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | arrays,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(), inner, max_size=3)
        | st.builds(Pair, inner, inner)
        | st.builds(Push, inner, st.text())
        | st.builds(fj.Efforts, inner, inner)
    ),
    max_leaves=8,
)


@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(trees)
def test_any_tree(path, tree):
    saved_and_loaded(path, tree, OWN)


class Careful(eqx.Module):
    value: float

    def __init__(self, value):
        assert value is not None
        self.value = value + 1


def test_no_constructor_is_called(path):
    saved_and_loaded(path, Careful(1.0), (Careful,))
    saved_and_loaded(path, eqx.tree_at(lambda c: c.value, Careful(1), None), (Careful,))


def test_classes_of_a_script(path, monkeypatch):
    push = Push(jnp.ones(3), "own")
    monkeypatch.setattr(Push, "__module__", "__main__")
    fj.save(path, push)
    monkeypatch.undo()
    same(fj.load(path, [Push]), push)
    fj.save(path, push)
    monkeypatch.setattr(Push, "__module__", "__main__")
    same(fj.load(path, [Push]), push)
    monkeypatch.setattr(Push, "__module__", "elsewhere")
    refused(path, "saved_trees:Push", [Push])


READER = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import fdof_jax as fj
assert "fdof_jax.tuning.result" not in sys.modules
run, scene = fj.load(sys.argv[1])
fj.save(sys.argv[2], (run, scene))
assert type(run).__module__ == "fdof_jax.tuning.result"
"""


def test_another_process_reads_it(path, tmp_path):
    """The other process imports the library's modules while it reads."""
    from fdof_jax.tuning.result import History

    run = History(*range(len(dataclasses.fields(History))))
    fj.save(path, (run, SCENES["fig7"]))
    other = tmp_path / "other"
    arguments = [sys.executable, "-c", READER, path, other]
    subprocess.run(arguments, check=True, env=os.environ, timeout=120)
    same(fj.load(other), (run, SCENES["fig7"]))
    assert other.read_bytes() == path.read_bytes()


def test_members_that_another_version_counts_differently(path):
    fj.save(path, [Colour.red, Colour.green])

    def swap(description):
        for node in description["tree"]:
            node["members"] = {"red": 1, "green": 0}

    describe(path, swap)
    same(fj.load(path, OWN), [Colour.green, Colour.red])
    describe(path, lambda d: d["tree"][0].update(members={"red": 1, "blue": 0}))
    refused(path, "Colour.*blue", OWN)


OF_0_1 = Path(__file__).parent / "saved_by_0.1.fdof"


def equal(a, b):
    """Checks equality apart from JAX's weak types, which constructors may change."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_a_file_of_version_0_1():
    """Such a file names the module of each class; later versions have moved classes."""
    tree = fj.load(OF_0_1, OWN)
    equal(tree["scenes"], SCENES)
    equal(tree["elements"], elements.ALL)
    assert tree["functions"] == [fj.sweep, fj.tuning.tip_errors, fj.simulate]
    assert type(tree["tuned"]) is fj.TuneResult
    assert type(tree["optimal"]) is fj.tuning.OptimalMotion
    assert tree["solution"].outcome == "successful"
    travel = fj.references.Travel(2.0, begin=0.5, profile="trapezoidal")
    spline = fj.references.Spline([[0, 0], [1, 0], [1, 1], [0, 1]], closed=True)
    equal(tree["references"][7], fj.TipTask(spline, travel, orientation=0.1))


def test_what_the_command_line_saves(path):
    saved_and_loaded(path, {"job": Job(), "search": {"seed": 1}, "results": []})


def test_files_name_no_module(path):
    """Checks that classes can change module while files stay readable."""
    fj.save(path, fj.load(OF_0_1, OWN))
    with zipfile.ZipFile(path) as archive:
        text = archive.read("description.json").decode()
    names = re.findall(r'"(?:class|name)": "([^"]*)"', text)
    assert {name.partition(":")[0] for name in names} == {
        "diffrax",
        "elements",
        "fdof_jax",
    }
