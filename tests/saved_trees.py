"""Saves, loads and damages trees; defines user classes to be saved."""

import dataclasses
import json
import struct
import zipfile
from typing import Any, NamedTuple

import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import scenes

SCENES = {"fig3": scenes.fig3(), "fig5": scenes.fig5(), "fig7": scenes.fig7()}


def bits(leaf):
    """Returns everything about a leaf that could have changed."""
    if isinstance(leaf, float) and not isinstance(leaf, np.generic):
        return float, struct.pack("d", leaf)
    if not isinstance(leaf, jax.Array | np.ndarray | np.generic):
        return type(leaf), leaf
    kind = type(leaf), leaf.dtype, leaf.shape, getattr(leaf, "weak_type", None)
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return *kind, np.asarray(leaf).tobytes()


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    assert [*map(bits, jax.tree.leaves(a))] == [*map(bits, jax.tree.leaves(b))]


def saved_and_loaded(path, tree, classes=()):
    fj.save(path, tree)
    loaded = fj.load(path, classes)
    same(loaded, tree)
    return loaded


def describe(path, change):
    """Changes a file's description by `change`, and leaves the file valid."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    description = json.loads(members["description.json"])
    change(description)
    members["description.json"] = json.dumps(description).encode()
    archived(path, members)


def archived(path, members):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def refused(path, words, classes=()):
    """Checks that the error message names the file and the fault."""
    with pytest.raises(ValueError, match=rf"(?s)^{path}: expected .*{words}.*\.$"):
        fj.load(path, classes)


# Classes of a user


class Push(eqx.Module):
    gain: Any
    name: str = eqx.field(static=True)

    def __call__(self, t, q, qd, linkage):
        return self.gain * jnp.cos(t) * jnp.ones(3)


class Pair(NamedTuple):
    left: Any
    right: Any


class Nothing(NamedTuple):
    pass


@dataclasses.dataclass
class Plain:
    number: int


class Colour(eqx.Enumeration):
    red = "It is red."
    green = "It is green."


OWN = (elements.Swing, elements.Hold, Push, Pair, Nothing, Plain, Colour)
