"""Keeps the results of finished chunks in a folder, and checks what it reads there."""

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..base.user_warnings import warn
from ..base.whole_files import whole_file
from .versions import VERSIONS


class Rows:
    """Shapes, without the leading axis of members, and dtypes of a chunk's arrays."""

    def __init__(self, arrays: list[Any]):
        self.kinds = [(array.shape[1:], np.dtype(array.dtype)) for array in arrays]

    def described(self, size: int) -> list[tuple[str, tuple[int, ...]]]:
        return [(dtype.name, (size, *shape)) for shape, dtype in self.kinds]

    def empty(self, size: int) -> list[np.ndarray]:
        return [np.empty((size, *shape), dtype) for shape, dtype in self.kinds]

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

    def __init__(self, folder: Path, sweep: str):
        """Uses a folder for the sweep of this digest."""
        self.folder, self.sweep = folder, sweep

    def _chunk(self, members: np.ndarray, lanes: int) -> tuple[Path, dict[str, Any]]:
        """Returns the file of a chunk, named by a digest, and what the digest is of."""
        holds = {
            "versions": VERSIONS,
            "sweep": self.sweep,
            "members": members.tolist(),
            "lanes": lanes,
        }
        name = hashlib.sha256(json.dumps(holds).encode()).hexdigest()[:32]
        return self.folder / f"{name}.chunk", holds

    def has(self, members: np.ndarray, lanes: int) -> bool:
        return self._chunk(members, lanes)[0].exists()

    def read(
        self, members: np.ndarray, lanes: int, rows: Rows
    ) -> list[np.ndarray] | None:
        """Returns a chunk's arrays; warns and returns None if its file is no good."""
        path, holds = self._chunk(members, lanes)
        line, _, data = path.read_bytes().partition(b"\n")
        if line == _line(holds, rows, data):
            return rows.split(len(members), data)
        warn(
            f"sweep: expected in {path} an undamaged chunk of this sweep, got another "
            f"file; its {len(members)} members are solved again.",
            RuntimeWarning,
        )
        return None

    def write(self, members: np.ndarray, lanes: int, arrays: list[np.ndarray]) -> None:
        path, holds = self._chunk(members, lanes)
        data = b"".join(array.tobytes() for array in arrays)
        with whole_file(path) as file:
            file.write(_line(holds, Rows(arrays), data) + b"\n" + data)


def _line(holds: dict[str, Any], rows: Rows, data: bytes) -> bytes:
    """Returns the first line of a chunk's file."""
    arrays = rows.described(len(holds["members"]))
    checksum = hashlib.sha256(data).hexdigest()
    return json.dumps(holds | {"arrays": arrays, "sha256": checksum}).encode()
