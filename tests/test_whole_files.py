"""A file appears whole, or not at all."""

import errno
import os
import re
import threading

import pytest

from fdof_jax.base.whole_files import whole_file


def write(path, data):
    with whole_file(path) as file:
        file.write(data)


def test_a_full_disk_names_the_path_and_leaves_no_part(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write(path, b"before")

    def full(number):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=re.escape(str(path))) as raised:
        write(path, b"after")
    assert raised.value.errno == errno.ENOSPC
    assert [*tmp_path.iterdir()] == [path] and path.read_bytes() == b"before"


def test_two_writers_of_one_file_do_not_meet(tmp_path, monkeypatch):
    both = threading.Barrier(2, timeout=60)  # both files are open at once
    monkeypatch.setattr(os, "fsync", lambda number: both.wait())
    path, data = tmp_path / "file", (b"one" * 1000, b"two" * 1000)
    writers = [threading.Thread(target=write, args=(path, some)) for some in data]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [*tmp_path.iterdir()] == [path] and path.read_bytes() in data
