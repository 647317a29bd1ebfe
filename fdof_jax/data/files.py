"""Saving the library's pytrees in a file, and loading them without a template.

A file is a zip archive. Its `description.json` holds the tree and the versions that
wrote it; each array is a member in NumPy's `.npy` format.
"""

import io
import json
import os
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import __version__
from ..whole_files import whole_file
from .tree_description import Restorer, Unreadable, described

_FORMAT, _VERSION = "fdof_jax", 1
_DESCRIPTION = "description.json"


def _read(file: Any, classes: Sequence[type]) -> Any:
    if file.read(2) != b"PK":
        raise Unreadable("expected a file that fdof_jax.save has written, got another")
    with zipfile.ZipFile(file) as archive:
        if _DESCRIPTION not in archive.namelist():
            raise Unreadable(
                "expected a file that fdof_jax.save has written, got another archive"
            )
        description = json.loads(archive.read(_DESCRIPTION))
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

        def array(index: int) -> np.ndarray:
            # zipfile checks the checksum only if the member is read to its end.
            member = io.BytesIO(archive.read(f"arrays/{index}.npy"))
            return np.lib.format.read_array(member, allow_pickle=False)

        return Restorer(array, classes).tree(description["tree"])


def _checked(path: Any) -> Path:
    try:
        return Path(path)
    except TypeError:
        raise ValueError(f"path: expected a path, got {path!r}.") from None


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
    path = _checked(path)
    arrays: list[np.ndarray] = []
    try:
        tree_node = described("tree", tree, arrays)
    except RecursionError:
        raise ValueError(
            "tree: expected one without itself in it, got one nested without end."
        ) from None
    modules = (jax, diffrax, eqx, np)
    description = {
        "format": _FORMAT,
        "version": _VERSION,
        "written by": {_FORMAT: __version__}
        | {module.__name__: module.__version__ for module in modules},
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
    disabled; the message names the file and the reason.
    """
    path = _checked(path)
    if not isinstance(classes, tuple | list) or not all(
        isinstance(c, type) for c in classes
    ):
        raise ValueError(f"classes: expected a tuple of classes, got {classes!r}.")
    with path.open("rb") as file:
        try:
            return _read(file, classes)
        except Unreadable as problem:
            raise ValueError(f"{path}: {problem}.") from None
        except Exception as error:  # zipfile, NumPy and JSON raise many kinds
            raise ValueError(
                f"{path}: expected a whole file, got one that is damaged or cut short "
                f"({type(error).__name__}: {error})."
            ) from error
