"""What could not be loaded is not saved, and a failed save changes nothing."""

import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from saved_trees import SCENES, Plain, Push, describe, saved_and_loaded

import fdof_jax as fj
from fdof_jax.references.timing import PROFILES
from fdof_jax.steps.looped_dopri8 import LoopedDopri8


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tree.fdof"


def cyclic():
    items = []
    items.append(items)
    return items


deleted = jnp.ones(3) + 1
deleted.delete()

UNSAVED = {
    "class that only the library uses": (LoopedDopri8(), "LoopedDopri8"),
    "lambda": (lambda t, linkage: (t, t), "equinox.Module.*<lambda>"),
    "function of one's own": (describe, "equinox.Module.*describe"),
    "lambda of the library": (PROFILES["quintic"], "equinox.Module.*<lambda>"),
    "function of another library": (jnp.linalg.norm, "norm"),
    "method": (Push(1.0, "").__call__, "bound method"),
    "class": (Push, "class .*Push"),
    "object": (object(), "object"),
    "bytes": (b"abc", "b'abc'"),
    "keys": ({1: 2}, r"strings as keys, got \[1\]"),
    "objects": (np.array([None]), "numbers, got one of object"),
    "structured": (np.zeros(2, [("a", "f8")]), "numbers, got one of"),
    "masked": (np.ma.zeros(2), "masked_array"),
    "deleted": (deleted, "deleted"),
}


@pytest.mark.parametrize("name", UNSAVED)
def test_what_cannot_be_saved(name, path):
    value, words = UNSAVED[name]
    fj.save(path, "older")
    before = path.read_bytes()
    scene = SCENES["fig7"]
    controller = eqx.tree_at(lambda c: c.reference, scene.forces[0], value)
    forces = (fj.JointDamper(1.0), controller)
    place = r"^tree\.forces\[1\]\.reference: expected"
    with pytest.raises(ValueError, match=rf"(?s){place} .*{words}.*\.$"):
        fj.save(path, scene._replace(forces=forces))
    with pytest.raises(ValueError, match=r"^tree\['a'\]\[0\]\['b'\]: expected"):
        fj.save(path, {"a": [{"b": value}]})
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_an_open_file_cannot_be_saved(path):
    with open(__file__) as file:
        with pytest.raises(ValueError, match=r"^tree\[0\]: expected .*TextIOWrapper"):
            fj.save(path, (file,))


def test_a_field_without_a_value_cannot_be_saved(path):
    with pytest.raises(ValueError, match=r"^tree\.number: expected a value, got none"):
        fj.save(path, object.__new__(Plain))


def test_a_tree_without_end_cannot_be_saved(path):
    with pytest.raises(ValueError, match="^tree: expected .*without end"):
        fj.save(path, cyclic())


def test_a_traced_value_cannot_be_saved(path):
    with pytest.raises(ValueError, match=r"^tree\[0\]: expected .*outside of jit"):
        jax.jit(lambda x: fj.save(path, [x]))(1.0)
    assert not path.exists()


@pytest.mark.parametrize("broken", ["write_array", "replace"])
def test_a_failed_save_leaves_the_older_file(broken, path, monkeypatch):
    fj.save(path, SCENES["fig3"])
    before = path.read_bytes()

    def full(*arguments, **keywords):
        raise OSError("No space left on device")

    where = {"write_array": np.lib.format, "replace": os}[broken]
    monkeypatch.setattr(where, broken, full)
    with pytest.raises(OSError, match="No space left"):
        fj.save(path, SCENES["fig7"])
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_a_file_is_replaced(path):
    saved_and_loaded(str(path), SCENES["fig7"])
    saved_and_loaded(path, 1)
    assert os.listdir(path.parent) == [path.name]
