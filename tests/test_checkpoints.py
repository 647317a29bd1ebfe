"""Files of a checkpoint that are no good are solved again, and reported."""

import errno
import os
import re
import sys
import threading
from pathlib import Path

import jax
import numpy as np
import pytest
import sweep_batch
from sweep_batch import run

import fdof_jax as fj
from fdof_jax.base.whole_files import folder_path
from fdof_jax.batches import checkpoints
from fdof_jax.batches.checkpoints import Checkpoint, Rows

MEMBERS, LANES = np.arange(3), 7


def arrays():
    return [np.linspace(0, 1, 6).reshape(3, 2), np.arange(3, dtype=np.int32)]


ROWS = Rows(arrays())


@pytest.fixture
def checkpoint(tmp_path):
    made = Checkpoint(tmp_path, "digest")
    made.write(MEMBERS, LANES, arrays())
    return made


def the_file(checkpoint):
    (path,) = checkpoint.folder.iterdir()
    return path


def refused(checkpoint, rows=ROWS):
    path = re.escape(str(the_file(checkpoint)))
    with pytest.warns(RuntimeWarning, match=f"in {path} an .* 3 members are solved"):
        return checkpoint.read(MEMBERS, LANES, rows) is None


def test_a_chunk_is_read_as_it_was_written(checkpoint):
    assert checkpoint.has(MEMBERS, LANES)
    assert not checkpoint.has(MEMBERS + 1, LANES)
    assert not checkpoint.has(MEMBERS, LANES + 1)
    found = checkpoint.read(MEMBERS, LANES, ROWS)
    for a, b in zip(found, arrays(), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_every_damage_is_found(checkpoint):
    path = the_file(checkpoint)
    whole = path.read_bytes()
    for place in range(len(whole)):
        flipped = bytearray(whole)
        flipped[place] ^= 1
        path.write_bytes(flipped)
        assert refused(checkpoint)
        path.write_bytes(whole[:place])
        assert refused(checkpoint)
    path.write_bytes(whole + b"0")
    assert refused(checkpoint)


def test_arrays_of_another_kind_are_refused(checkpoint):
    half = [arrays()[0].astype(np.float16), arrays()[1]]
    assert refused(checkpoint, Rows(half))  # what was kept is not what is expected
    checkpoint.write(MEMBERS, LANES, half)
    assert refused(checkpoint)
    checkpoint.write(MEMBERS, LANES, [arrays()[0][:, :1], arrays()[1]])
    assert refused(checkpoint)


def test_another_chunk_and_another_version_are_refused(checkpoint, monkeypatch):
    path = the_file(checkpoint)
    checkpoint.write(MEMBERS + 1, LANES, arrays())
    (other,) = set(checkpoint.folder.iterdir()) - {path}
    os.replace(other, path)
    assert refused(checkpoint)
    checkpoint.write(MEMBERS, LANES, arrays())
    monkeypatch.setitem(checkpoints.VERSIONS, "jax", "0.1")
    assert not checkpoint.has(MEMBERS, LANES)


def test_a_sweep_solves_again_what_is_damaged(mixed, swept, tmp_path):
    run(mixed, checkpoint=tmp_path)
    saved = sorted(tmp_path.iterdir())
    content = [path.read_bytes() for path in saved]
    saved[0].write_bytes(content[1])
    saved[2].write_bytes(b"")
    with pytest.warns(RuntimeWarning) as warned:
        again = run(mixed, checkpoint=tmp_path)
    assert {w.filename for w in warned} == {sweep_batch.__file__}
    named = {path for path in saved for w in warned if str(path) in str(w.message)}
    assert named == {saved[0], saved[2]}
    assert [path.read_bytes() for path in saved] == content
    for a, b in zip(*map(jax.tree.leaves, (again, swept)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_full_disk_names_the_path_and_leaves_no_part(checkpoint, monkeypatch):
    path = the_file(checkpoint)
    whole = path.read_bytes()

    def full(number):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=re.escape(str(path))) as raised:
        checkpoint.write(MEMBERS, LANES, arrays())
    assert raised.value.errno == errno.ENOSPC
    assert the_file(checkpoint) == path and path.read_bytes() == whole


def test_two_writers_of_one_chunk_do_not_meet(checkpoint, monkeypatch):
    both = threading.Barrier(2, timeout=60)  # both files are open at once
    monkeypatch.setattr(os, "fsync", lambda number: both.wait())
    failed = []

    def write():
        try:
            checkpoint.write(MEMBERS, LANES, arrays())
        except Exception as error:
            failed.append(error)

    writers = [threading.Thread(target=write) for _ in range(2)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert not failed
    assert checkpoint.read(MEMBERS, LANES, ROWS) is not None


@pytest.mark.parametrize("argument", ["store", "checkpoint"])
def test_what_cannot_be_a_folder(argument, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("kept")
    linkage, states = fj.scenes.fig5().linkage, fj.State(np.zeros((2, 3)), np.zeros(3))
    for value, words in (
        ("file", "can be made, got 'file': File exists"),
        ("file/below", "can be made, got 'file/below': Not a directory"),
        ("a\0b", "a folder, got"),
        ("s3://bucket/x", "a folder on this machine, no address, got"),
        (Path("s3://bucket/x"), "a folder on this machine, no address, got"),
    ):
        with pytest.raises(ValueError, match=f"^{argument}: expected .*{words}"):
            fj.sweep(linkage, states, [0, 1], **{argument: value})
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_paths_of_a_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert folder_path("checkpoint", "~/kept") == tmp_path / "kept"
    assert (tmp_path / "kept").is_dir()
    # Refused before anything is traced
    monkeypatch.setattr(sys.modules["fdof_jax.batches.sweep"], "outline", None)
    with pytest.raises(ValueError, match="^checkpoint: expected a folder, got ''"):
        fj.sweep(
            fj.scenes.fig5().linkage,
            fj.State(np.zeros((2, 3)), np.zeros(3)),
            [0, 1],
            checkpoint="",
        )
