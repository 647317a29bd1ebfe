"""Paths that arguments give, and files that appear only when complete."""

import contextlib
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from .checks import refusal, shown

# Of an address such as s3://bucket/name, which `Path` would take for a folder.
_SCHEME = re.compile("[A-Za-z][A-Za-z0-9+.-]+:/")


def local_path(name: str, value: object, expected: str) -> Path:
    """Returns the local path that the argument `name` gives; `~` is the home folder.

    Raises ValueError for an address, an empty path, and what is no path.
    """
    path = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(path, str) or not path or "\0" in path:
        raise refusal(name, expected, value)
    if _SCHEME.match(path):
        raise refusal(name, f"{expected} on this machine, no address", value)
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise refusal(name, f"{expected} in a home that exists", value) from None


def file_path(name: str, value: Any) -> Path:
    """Returns the path of a file that the argument `name` gives."""
    path = local_path(name, value, "a path")
    if not os.path.basename(value) or path.is_dir():  # such as a/
        raise refusal(name, "the path of a file, not of a folder", value)
    if path.exists() and not path.is_file():
        raise refusal(name, "the path of a file, not of a pipe or a device", value)
    return path


def folder_path(
    name: str, value: object, expected: str = "a folder", within: str = ""
) -> Path:
    """Returns the folder `within` the one that `name` gives, made if need be."""
    folder = local_path(name, value, expected) / within
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder, suffix=".part"):
            return folder
    except OSError as error:
        raise ValueError(
            f"{name}: expected {expected} that can be written, got {shown(value)}: "
            f"{error.strerror}."
        ) from error


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Opens a new file; it replaces that at `path` when the block ends without error.

    After an error it is removed. It has the permissions of the old file; a link at
    `path` stays. An OSError names `path`.
    """
    target = Path(os.path.realpath(path))
    # Names have at most 255 bytes, of which a letter takes up to four.
    unfinished = target.with_name(f"{target.name[:50]}.{secrets.token_hex(4)}.part")
    try:
        with unfinished.open("xb") as file:
            with contextlib.suppress(FileNotFoundError):
                unfinished.chmod(stat.S_IMODE(path.stat().st_mode))
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, target)
    except OSError as error:
        if error.errno is None:  # not of the system
            raise
        # The error of a full disk names no file.
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):  # replaced, or never made
            unfinished.unlink()
