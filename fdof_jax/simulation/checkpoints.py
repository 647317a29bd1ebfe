"""Keeps the results of finished chunks in a folder, and checks what it reads there."""

import hashlib
import json
import math
import os
import warnings
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import numpy as np

from .. import __version__
from ..checks import refusal
from ..whole_files import whole_file

_VERSIONS = {"fdof_jax": __version__} | {
    module.__name__: module.__version__ for module in (jax, diffrax, eqx, np)
}


class Rows:
    """Shapes, without the leading axis of members, and dtypes of a chunk's arrays."""

    def __init__(self, arrays: list[Any]):
        self.kinds = [(array.shape[1:], np.dtype(array.dtype)) for array in arrays]

    def described(self, size: int) -> list[tuple[str, tuple[int, ...]]]:
        return [(dtype.name, (size, *shape)) for shape, dtype in self.kinds]

    def split(self, size: int, data: bytes) -> list[np.ndarray]:
        """Returns the arrays whose bytes follow one another in `data`."""
        arrays, offset = [], 0
        for shape, dtype in self.kinds:
            arrays.append(np.ndarray((size, *shape), dtype, data, offset))
            offset += size * math.prod(shape) * dtype.itemsize
        return arrays


class Checkpoint:
    """A folder with a file for each finished chunk of a sweep.

    The first line of a file is JSON: the versions that wrote it, a digest of the
    sweep's inputs, the members, the types and shapes of the arrays and a checksum of
    the arrays' bytes, which follow.
    """

    def __init__(self, folder: str | os.PathLike, settings: Any, arrays: Any):
        """Names the sweep by the text of its settings and the values of its arrays."""
        if not isinstance(folder, str | os.PathLike) or not os.fspath(folder):
            raise refusal("checkpoint", "a folder", folder)
        self.folder = Path(os.path.expanduser(folder))
        self.folder.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha256(repr(settings).encode())
        for leaf in map(np.asarray, jax.tree.leaves(arrays)):
            digest.update(repr((leaf.shape, leaf.dtype)).encode())
            digest.update(leaf.tobytes())
        self.sweep = digest.hexdigest()

    def _chunk(self, members: np.ndarray, limit: int) -> tuple[Path, dict[str, Any]]:
        """Returns a chunk's file and what it holds; other members have another file."""
        holds = {
            "versions": _VERSIONS,
            "sweep": self.sweep,
            "members": members.tolist(),
            "limit of steps": limit,
        }
        name = hashlib.sha256(json.dumps(holds).encode()).hexdigest()[:32]
        return self.folder / f"{name}.chunk", holds

    def has(self, members: np.ndarray, limit: int) -> bool:
        return self._chunk(members, limit)[0].exists()

    def read(
        self, members: np.ndarray, limit: int, rows: Rows
    ) -> list[np.ndarray] | None:
        """Returns a chunk's arrays; warns and returns None if its file is no good."""
        path, holds = self._chunk(members, limit)
        line, _, data = path.read_bytes().partition(b"\n")
        if line == _line(holds, rows, data):
            return rows.split(len(members), data)
        warnings.warn(
            f"sweep: expected in {path} an undamaged chunk of this sweep, got another "
            f"file; its {len(members)} members are solved again.",
            RuntimeWarning,
            stacklevel=2,
        )
        return None

    def write(self, members: np.ndarray, limit: int, arrays: list[np.ndarray]) -> None:
        path, holds = self._chunk(members, limit)
        data = b"".join(array.tobytes() for array in arrays)
        with whole_file(path) as file:
            file.write(_line(holds, Rows(arrays), data) + b"\n" + data)


def _line(holds: dict[str, Any], rows: Rows, data: bytes) -> bytes:
    """Returns the first line of a chunk's file."""
    arrays = rows.described(len(holds["members"]))
    checksum = hashlib.sha256(data).hexdigest()
    return json.dumps(holds | {"arrays": arrays, "sha256": checksum}).encode()
