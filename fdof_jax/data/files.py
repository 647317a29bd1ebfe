"""Saving the library's pytrees in a file, and loading them without a template.

A file is a zip archive. Its `description.json` holds the tree and the versions that
wrote it; each array is a member in NumPy's `.npy` format.
"""

import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..base.checks import plain, shown
from ..base.whole_files import file_path, whole_file
from ..batches.versions import VERSIONS
from .tree_description import Restorer, Unreadable, described

_FORMAT, _VERSION = "fdof_jax", 1
_DESCRIPTION = "description.json"
# `save` does not compress, but another program may have compressed a file afterwards.
_EXPANSION = 16
# What zipfile, NumPy, JSON and `Restorer` raise for a damaged file. Other errors, for
# instance of a device or of memory, say nothing about the file.
_DAMAGED = (
    zipfile.BadZipFile, EOFError, LookupError, ValueError, TypeError, AttributeError,
    struct.error, zlib.error, RecursionError, NotImplementedError,
)  # fmt: skip


def _read(file: Any, classes: Sequence[type]) -> Any:
    if file.read(2) != b"PK":
        raise Unreadable("expected a file that fdof_jax.save has written, got another")
    with zipfile.ZipFile(file) as archive:
        if _DESCRIPTION not in archive.namelist():
            raise Unreadable(
                "expected a file that fdof_jax.save has written, got another archive"
            )
        _check_sizes(file, archive.infolist())
        description = json.loads(_content(archive, _DESCRIPTION))
        if description["format"] != _FORMAT:
            raise Unreadable(
                f"expected the format {_FORMAT}, got {description['format']}"
            )
        if description["version"] > _VERSION:
            writer = description["written by"][_FORMAT]
            raise Unreadable(
                f"expected version {_VERSION} of the format, got "
                f"{description['version']}: fdof_jax {writer}, which wrote it, "
                "or a newer version can read it"
            )

        unread = set(archive.namelist())

        def array(index: int) -> np.ndarray:
            # Each array has one place, which limits their memory.
            unread.remove(name := f"arrays/{index}.npy")
            return _array(_content(archive, name))

        return Restorer(array, classes).tree(description["tree"])


def _check_sizes(file: Any, members: Sequence[zipfile.ZipInfo]) -> None:
    """Raises Unreadable if the members may take much more memory than the file."""
    size = os.stat(file.fileno()).st_size
    known, encrypted = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED), 1
    for member in members:
        within = 0 <= member.header_offset < size
        plain = member.compress_type in known and not member.flag_bits & encrypted
        if not within or not plain:
            raise Unreadable(
                "expected contents that fdof_jax.save has written, got "
                f"{member.filename} encrypted, compressed in another way or damaged"
            )
    declared = sum(member.file_size for member in members)
    if declared > _EXPANSION * size:
        raise Unreadable(
            f"expected contents of at most {_EXPANSION} times the {size} bytes of the "
            f"file, got {declared} bytes: it is damaged"
        )


def _content(archive: zipfile.ZipFile, name: str) -> bytes:
    with archive.open(name) as member:
        # Without a number zipfile would inflate more than the member declares.
        return member.read(archive.getinfo(name).file_size)


def _array(content: bytes) -> np.ndarray:
    """Returns the array of a `.npy` file of the version that `save` writes."""
    member = io.BytesIO(content)
    if np.lib.format.read_magic(member) != (1, 0):
        raise ValueError("another version of NumPy's format")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(member)
    if dtype.hasobject or dtype.fields:
        raise ValueError("an array of objects or structures")
    # `read_array` would reserve what the header declares before it reads.
    order = "F" if fortran else "C"
    return np.ndarray(shape, dtype, content, member.tell(), order=order).copy("K")


def save(path: str | os.PathLike, tree: Any) -> None:
    """Writes a pytree of the library to a file, for `load`.

    An existing file is replaced atomically, when the new one is complete.

    **Arguments:**

    - `path`: path of the file; no suffix is added.
    - `tree`: a `Scene`, a `Linkage`, force elements, a `Solution`, a `TuneResult`, an
      `equinox.Module` of your own, or nested lists, tuples, dicts with strings as keys,
      NamedTuples and dataclasses of these. Leaves are arrays of NumPy and JAX, numbers,
      strings, None, random keys and functions of the library.

    **Raises:** ValueError for parts that cannot be saved, with their place in the tree:
    a lambda or another function of your own, a traced value, an object of another kind.
    No file is then written, and an existing one is kept.

    >>> import fdof_jax as fj
    >>> import os, tempfile
    >>> path = os.path.join(tempfile.mkdtemp(), "fig7.fdof")
    >>> fj.save(path, fj.scenes.fig7())
    >>> fj.load(path).linkage.length.tolist()
    [0.0, 1.0, 2.5, 1.0]
    """
    path = file_path("path", path)
    arrays: list[np.ndarray] = []
    try:
        tree_node = described("tree", tree, arrays)
    except RecursionError:
        raise ValueError(
            "tree: expected one without itself in it, got one nested without end."
        ) from None
    description = {
        "format": _FORMAT,
        "version": _VERSION,
        "written by": VERSIONS,
        "default dtype": jnp.result_type(float).name,
        "tree": tree_node,
    }
    text = json.dumps(description, allow_nan=False, indent=1)
    with whole_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(_DESCRIPTION), text)
        for index, array in enumerate(arrays):
            info = zipfile.ZipInfo(f"arrays/{index}.npy")
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def load(path: str | os.PathLike, classes: Sequence[type] = ()) -> Any:
    """Loads the pytree that `save` wrote to a file, equal to the last bit.

    Its structure is also equal, so that programs compiled for the saved tree serve the
    loaded one. Nothing in the file is executed, and no constructor is called.

    **Arguments:**

    - `path`: path of the file.
    - `classes`: a tuple of your own classes with saved instances.

    **Returns:** the tree; its JAX arrays are on the default device.

    **Raises:** FileNotFoundError if there is no file. ValueError if the file was not
    written by `save`, is damaged or cut short, has a newer format, holds a class that
    is unknown or has other fields, or holds arrays in double precision while JAX has it
    disabled; the message names the file and the reason. A file that holds far
    more than its size is refused before it is read.
    """
    path = file_path("path", path)
    if not isinstance(classes, tuple | list) or not all(
        isinstance(c, type) for c in classes
    ):
        raise ValueError(f"classes: expected a tuple of classes, got {shown(classes)}.")
    with path.open("rb") as file:
        try:
            return _read(file, classes)
        except Unreadable as problem:
            raise ValueError(f"{plain(str(path))}: {problem}.") from None
        except _DAMAGED as error:
            raise ValueError(
                f"{plain(str(path))}: expected a whole file, got one that is damaged "
                f"or cut short ({type(error).__name__}: {error})."
            ) from error
