"""Saved trees are loaded unchanged."""

import dataclasses
import os
import struct

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
    same,
    saved_and_loaded,
)

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.simulation import prescribed
from fdof_jax.steps.looped_dopri8 import LoopedDopri8
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
    saved_and_loaded(path, fj.simulation.PrescribedMotion((1, 3), REFERENCES[name]))


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
        | st.builds(fj.simulation.Efforts, inner, inner)
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
