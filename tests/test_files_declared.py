"""Files are read within their size, and are not blamed for other failures."""

import io
import tracemalloc
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
from saved_trees import archived, describe, refused

import fdof_jax as fj


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tree.fdof"


def refused_within_20_mb(path, words):
    tracemalloc.start()
    refused(path, words)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6


def contents(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.parametrize(
    "method, words",
    [
        (zipfile.ZIP_DEFLATED, "at most 16 times .* got 1000"),
        (zipfile.ZIP_LZMA, "got {name} .*compressed in another way"),
    ],
)
@pytest.mark.parametrize("name", ["description.json", "arrays/0.npy"])
def test_nothing_is_inflated(method, words, name, path):
    fj.save(path, np.zeros(4))
    members = contents(path) | {name: bytes(10**8)}
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in members.items():
            how = method if member == name else zipfile.ZIP_STORED
            archive.writestr(member, content, how)
    refused_within_20_mb(path, words.format(name=name))


@pytest.mark.parametrize("declared", [10**5, 2**31])
def test_no_member_inflates_to_more_than_it_declares(declared, path):
    fj.save(path, np.zeros(4))
    members = contents(path) | {"arrays/0.npy": bytes(10**8)}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    size = (10**8).to_bytes(4, "little")
    path.write_bytes(path.read_bytes().replace(size, declared.to_bytes(4, "little")))
    refused_within_20_mb(path, "damaged")


def test_a_file_compressed_by_another_program_is_read(path):
    fj.save(path, np.arange(99))
    members = contents(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    np.testing.assert_array_equal(fj.load(path), np.arange(99))


def test_an_array_is_read_once(path):
    fj.save(path, [np.zeros(4), np.ones(4)])
    describe(path, lambda d: d["tree"][1].update(array=0))
    refused(path, "damaged.*arrays/0.npy")


@pytest.mark.parametrize("shape", [(10**7,), (10**15,), (5,)])
def test_an_array_is_as_long_as_it_says(shape, path):
    fj.save(path, np.zeros(4))
    member = io.BytesIO()
    kind = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(member, kind)
    archived(path, contents(path) | {"arrays/0.npy": member.getvalue() + bytes(32)})
    refused_within_20_mb(path, "damaged")


def test_an_array_of_structures_is_refused(path):
    """Its bytes would be taken for numbers of the same size."""
    fj.save(path, np.zeros(4))
    member = io.BytesIO()
    np.save(member, np.zeros(4, [("a", "<f4"), ("b", "<i4")]))
    archived(path, contents(path) | {"arrays/0.npy": member.getvalue()})
    refused(path, "damaged.*structures")


def test_arrays_in_any_order_of_axes_can_be_changed(path):
    tree = [np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.zeros((0, 3))]
    fj.save(path, tree)
    for a, b in zip(fj.load(path), tree, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.flags.writeable and a.strides == b.strides


@pytest.mark.parametrize("kind", [RuntimeError, MemoryError, OSError, ImportError])
def test_other_failures_are_raised_as_they_are(kind, path, monkeypatch):
    fj.save(path, jnp.zeros(4))

    def failing(*arguments):
        raise kind("no device")

    monkeypatch.setattr(jnp, "asarray", failing)
    with pytest.raises(kind, match="^no device$"):
        fj.load(path)
