"""Damaged and foreign files are not loaded."""

import contextlib
import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from saved_trees import (
    OWN,
    SCENES,
    Colour,
    Nothing,
    Pair,
    Push,
    archived,
    describe,
    refused,
    same,
)

import fdof_jax as fj


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tree.fdof"


@pytest.mark.parametrize("value", [None, 3, ["a"], b"a", "", "a\0b"])
def test_paths(value):
    for call in (lambda: fj.save(value, 1), lambda: fj.load(value)):
        with pytest.raises(ValueError, match="^path: expected a path, got "):
            call()


@pytest.mark.parametrize("value", [".", "..", "/", Path("."), "{}", "{}/", "{}/new/"])
def test_paths_of_folders(value, tmp_path):
    value = value.format(tmp_path) if isinstance(value, str) else value
    for call in (lambda: fj.save(value, 1), lambda: fj.load(value)):
        with pytest.raises(ValueError, match="^path: expected the path of a file, not"):
            call()
    assert not list(tmp_path.iterdir())


def test_addresses_are_no_paths():
    for value in ("s3://bucket/x", Path("gs://bucket/x")):
        with pytest.raises(ValueError, match="^path: expected .* no address, got"):
            fj.save(value, 1)


def test_a_missing_file(path):
    with pytest.raises(FileNotFoundError):
        fj.load(path)
    with pytest.raises(FileNotFoundError):
        fj.save(path / "none" / "none", 1)


@pytest.mark.parametrize("value", [Push, "Push", (3,), None])
def test_classes_that_are_none(value, path):
    fj.save(path, 1)
    with pytest.raises(ValueError, match="^classes: expected a tuple of classes, got"):
        fj.load(path, value)


def test_other_files(path):
    path.write_text("q,qd\n1,2\n")
    refused(path, "fdof_jax.save has written, got another")
    path.write_bytes(b"")
    refused(path, "fdof_jax.save has written, got another")
    with path.open("wb") as file:
        np.savez(file, q=np.ones(3))
    refused(path, "fdof_jax.save has written, got another archive")
    archived(path, {"description.json": '{"format": "gltf"}'})
    refused(path, "format fdof_jax, got gltf")


DAMAGES = {
    "no JSON": {"description.json": b"{'a': 1}"},
    "no object": {"description.json": b"[]"},
    "nesting": {"description.json": b"[" * 100_000},
    "no text": {"description.json": b"\xff\xfe"},
    "no array": {"arrays/0.npy": b""},
    "half an array": {"arrays/0.npy": None},
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_members(name, path):
    """The archive's checksums are right."""
    fj.save(path, np.arange(9.0))
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    half = {"arrays/0.npy": members["arrays/0.npy"][:-8]}
    archived(path, members | (DAMAGES[name] if name != "half an array" else half))
    refused(path, "damaged or cut short")


def test_a_missing_array(path):
    fj.save(path, np.arange(9.0))
    with zipfile.ZipFile(path) as archive:
        text = archive.read("description.json")
    archived(path, {"description.json": text})
    refused(path, "damaged or cut short .*arrays/0.npy")


NODES = {
    "shape": (dict(shape=[4]), r"\[4\]\), got \('float64', \[3\]\)"),
    "order of axes": (dict(shape=[3, 1]), r"\[3, 1\]\), got \('float64', \[3\]\)"),
    "dtype": (dict(dtype="float32"), "float32.*got .*float64"),
    "extended dtype": (dict(dtype="bfloat16"), "bfloat16.*got .*float64"),
    "no dtype": (dict(dtype="float65"), "float65.*got .*float64"),
    "another array": (dict(array=1), "damaged .*arrays/1.npy"),
    "outside": (dict(array="../../0"), "damaged"),
    "kind": (dict(kind="pickle"), "damaged .*pickle"),
    "no kind": (dict(kind=None), "damaged"),
    "bits": (dict(kind="float", bits="00"), "damaged"),
    "items": (dict(kind="tuple", items=3), "damaged"),
    "no items": (dict(kind="dict"), "damaged"),
    "key": (dict(kind="key", implementation="none"), "damaged"),
    "function": (dict(kind="function", name="os:system"), "function .* os:system"),
    "class as function": (
        dict(kind="function", name="fdof_jax.scenes:Scene"),
        "function .* fdof_jax.scenes:Scene",
    ),
}


@pytest.mark.parametrize("name", NODES)
def test_descriptions_that_do_not_fit(name, path):
    fj.save(path, np.arange(3.0))
    node, words = NODES[name]
    describe(path, lambda d: d["tree"].update(node))
    refused(path, words)


def test_a_newer_format(path):
    fj.save(path, SCENES["fig3"])

    def later(description):
        description["version"] = 2
        description["written by"]["fdof_jax"] = "7.8.9"
        description["tree"] = {"kind": "unheard of"}

    describe(path, later)
    refused(path, "version 1 of the format, got 2: fdof_jax 7.8.9")


def test_the_description_is_strict_json_and_says_who_wrote_it(path):
    fj.save(path, [np.nan, -np.inf])
    with zipfile.ZipFile(path) as archive:
        text = archive.read("description.json")

    def constant(name):
        raise AssertionError(name)

    description = json.loads(text, parse_constant=constant)
    assert description["format"] == "fdof_jax" and description["version"] == 1
    assert description["default dtype"] == "float64"
    writers = ["diffrax", "equinox", "fdof_jax", "jax", "numpy"]
    assert sorted(description["written by"]) == writers
    assert description["written by"]["jax"] == jax.__version__


def test_unknown_classes(path):
    fj.save(path, (Push(1.0, ""),))
    refused(path, "saved_trees:Push.*classes=")
    refused(path, "saved_trees:Push.*classes=", (Pair,))
    fj.save(path, Colour.red)
    refused(path, "saved_trees:Colour.*classes=")
    # A class that is neither a record nor an enumeration
    describe(path, lambda d: d["tree"].update({"class": "fdof_jax.scenes:Scene"}))
    refused(path, "enumeration, got fdof_jax.scenes:Scene")
    fj.save(path, Nothing())
    describe(path, lambda d: d["tree"].update({"class": "diffrax:RESULTS"}))
    refused(path, "diffrax:RESULTS with the fields None")


FORGED = """os:system subprocess:Popen builtins:object forged:Element
fdof_jax.files:os fdof_jax.files:eqx
fdof_jax.files:_Unreadable.__class__ fdof_jax.forged:Element fdof_jax_forged:Element
fdof_jax:Array diffrax:Solution diffrax:ODETerm
fdof_jax: : fdof_jax.scenes""".split()


@pytest.mark.parametrize("name", FORGED)
def test_nothing_else_is_imported(name, path, tmp_path, monkeypatch):
    for module in ("forged", "fdof_jax_forged"):
        text = "class Element: pass"
        (tmp_path / f"{module}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    fj.save(path, Nothing())
    describe(path, lambda d: d["tree"].update({"class": name}))
    refused(path, f"got {name}: import")
    assert not {"forged", "fdof_jax_forged", "fdof_jax.forged"} & set(sys.modules)


def version(*fields):
    class Element(eqx.Module):
        __annotations__ = dict.fromkeys(fields, Any)

    return Element


def test_a_class_with_other_fields(path):
    old, new = version("gain", "limit"), version("gain", "reference")
    fj.save(path, [old(1, 2)])
    refused(path, r"Element .*'reference'.* got \['gain', 'limit'\]", (new,))
    refused(path, r"\['gain'\].* got \['gain', 'limit'\]", (version("gain"),))
    # Their order has no meaning.
    turned = fj.load(path, (version("limit", "gain"),))[0]
    assert (turned.gain, turned.limit) == (1, 2)


def test_two_classes_of_one_name_are_refused(path):
    fj.save(path, [version("a")(1)])
    refused(path, "Element", (version("a"), version("a")))


@contextlib.contextmanager
def without_x64():
    jax.config.update("jax_enable_x64", False)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", True)


def test_double_precision_where_it_is_off(path):
    fj.save(path, {"jax": jnp.ones(3), "numpy": np.ones(3)})
    with without_x64():
        refused(path, "got float64: .*configure.x64=True")
    fj.save(path, [jnp.array([1, 2])])
    with without_x64():
        refused(path, "got int64: .*configure.x64=True")
    fj.save(path, np.ones(3))
    with without_x64():
        same(fj.load(path), np.ones(3))


def test_single_precision_where_double_is_on(path):
    with without_x64():
        tree = [jnp.ones(3), jnp.asarray(1.5)]
        fj.save(path, tree)
    single, weak = fj.load(path)
    same(single, tree[0])
    assert weak.dtype == np.float32 and weak == 1.5


# Damage anywhere


@pytest.fixture
def whole(path):
    tree = Pair(
        fj.JointDamper([1, 2, 3]), {"a": np.arange(2), "b": diffrax.RESULTS.successful}
    )
    fj.save(path, tree)
    return tree, path.read_bytes()


def unharmed(path, tree):
    """Returns whether a file can be read; checks the error if it cannot."""
    try:
        loaded = fj.load(path, OWN)
    except ValueError as error:
        assert str(error).startswith(f"{path}: expected ")
        return False
    same(loaded, tree)
    return True


def test_a_file_cut_anywhere(whole, path):
    tree, content = whole
    for length in range(len(content)):
        path.write_bytes(content[:length])
        assert not unharmed(path, tree), length
    path.write_bytes(content)
    assert unharmed(path, tree)


@pytest.mark.parametrize("flip", [0x01, 0xFF])
def test_a_byte_flipped_anywhere(flip, whole, path):
    tree, content = whole
    read = 0
    for place in range(len(content)):
        flipped = bytearray(content)
        flipped[place] ^= flip
        path.write_bytes(flipped)
        read += unharmed(path, tree)
    # A few bytes have no meaning, for instance dates.
    assert read < len(content) / 4
