"""Keeps the results of a sweep in a folder, a Zarr group, block by block of members."""

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.array_namespace import in_numpy
from ..base.checks import refusal
from ..base.devices import found_by_first
from ..base.user_warnings import warn
from ..base.whole_files import whole_file
from ..simulation.solution import Solution
from .batch_axes import Batch
from .chunks import Job, in_chunks
from .versions import VERSIONS
from .zarr_variables import Variable, coordinates, metadata, values_of, variables_of

_BYTES = 2**26  # of the results in a block
_CHUNKS = 16  # at most so many in a block, as blocks are what workers share


def _sha256(data: bytes | memoryview) -> str:
    return hashlib.sha256(data).hexdigest()


def _warn(expected: str, done: str) -> None:
    message = f"sweep: expected {expected}, got something else; {done}."
    warn(message, RuntimeWarning)


def _text(value: Any) -> bytes:
    return json.dumps(value, indent=1).encode()


def _record_name(block: int) -> str:
    return f"records/{block}.sha256"


class Store:
    """A folder that is a Zarr group, whose chunks along members are blocks.

    No two blocks share a file. A finished block has a record in the folder `records`:
    the checksums of its files and of the group's metadata, as `sha256sum` writes them.
    """

    def __init__(
        self, folder: Path, batch: Batch, ts: Array, like: Any, chunk: int, sweep: str
    ):
        """Writes the metadata of the group, or checks what is there."""
        self.folder, self.size = folder, batch.size
        failed = Variable("failed", np.dtype(bool), (), ["member"], {})
        self.variables = [*variables_of(like, batch.inputs[0]), failed]
        if any(v.name.casefold() == "failed" for v in self.variables[:-1]):
            raise refusal("reduce", "no part named failed beside a store", like)
        each = sum(v.dtype.itemsize * math.prod(v.shape) for v in self.variables)
        most = chunk * min(_CHUNKS, max(1, _BYTES // (chunk * each)))
        # Nearly equal blocks are solved by the same programs.
        self.block = -(-self.size // -(-self.size // most))
        self.count = -(-self.size // self.block)
        arrays = {
            v.name: metadata(
                v.dtype, (self.size, *v.shape), (self.block, *v.shape), *v[3:]
            )
            for v in self.variables
        }
        known = {}
        if isinstance(like, Solution):
            for name, (values, attributes) in coordinates(batch.inputs[0], ts).items():
                one = values.dtype, values.shape, values.shape, [name], attributes
                arrays[name] = metadata(*one)
                known[f"{name}/c/0"] = values.tobytes()
        provenance = {"versions": VERSIONS, "sweep": sweep, "chunk": chunk}
        group = {
            "zarr_format": 3,
            "node_type": "group",
            "attributes": provenance | {"sha256": _sha256(_text(provenance))},
            "consolidated_metadata": {
                "kind": "inline",
                "must_understand": False,
                "metadata": arrays,
            },
        }
        self._refuse_another(group["attributes"])
        self.named = _sha256(_text(group))
        known |= {f"{name}/zarr.json": _text(value) for name, value in arrays.items()}
        for name, data in ({"zarr.json": _text(group)} | known).items():
            path = folder / name
            if path.exists():
                if path.read_bytes() == data:
                    continue
                _warn(f"in {path} the metadata of this sweep", "it is written again")
            self._write(name, data)

    def _refuse_another(self, attributes: dict[str, Any]) -> None:
        """Raises ValueError if the folder holds anything but this sweep, or damage."""
        # In this order, as another worker may be about to write `zarr.json` first.
        names = {path.name for path in self.folder.iterdir() if path.suffix != ".part"}
        path = self.folder / "zarr.json"
        if not path.exists():
            if names and "records" not in names:
                raise self._another(f"holds {min(names)}")
            return
        try:
            group = json.loads(path.read_bytes())
        except ValueError:
            return  # damaged
        try:
            found = group["attributes"]
            provenance = {key: found[key] for key in attributes if key != "sha256"}
            whole = found["sha256"] == _sha256(_text(provenance))
        except (LookupError, TypeError):
            raise self._another("holds a Zarr group from elsewhere") from None
        if whole and found != attributes:
            others = [key for key in provenance if found[key] != attributes[key]]
            raise self._another(f"has another {', '.join(others)}")

    def _another(self, what: str) -> ValueError:
        return ValueError(
            f"store: expected a new folder or one of this sweep, got {self.folder}, "
            f"which {what}."
        )

    def members(self, block: int) -> slice:
        return slice(block * self.block, min(self.size, (block + 1) * self.block))

    def _files(self, block: int) -> dict[str, Variable]:
        """Returns the files of a block, with their variables."""
        axes = lambda variable: "/0" * len(variable.shape)
        return {f"{v.name}/c/{block}{axes(v)}": v for v in self.variables}

    def _record(self, block: int, sums: list[str]) -> list[str]:
        """Returns the lines of a block's record."""
        files = ["zarr.json", *self._files(block)]
        return [f"{total}  {file}" for total, file in zip([self.named, *sums], files)]

    def failed(self, block: int) -> np.ndarray | None:
        """Returns which members of a finished block failed, or None if it is to solve.

        Damaged files are reported by a warning.
        """
        files = self._files(block)
        record = self.folder / _record_name(block)
        if not record.exists():
            return None
        sums = [self._sum(file) for file in files]
        lines = self._record(block, sums)
        found, members = record.read_bytes(), self.members(block)
        if found == "\n".join(lines).encode():
            flags = np.fromfile(self.folder / list(files)[-1], bool)
            return flags[: members.stop - members.start]
        recorded = set(found.decode(errors="replace").split("\n"))
        damaged = [file for file, line in zip(files, lines[1:]) if line not in recorded]
        _warn(
            f"{', '.join(damaged) or 'files'} of {self.folder} with the checksums in "
            f"{record}",
            f"{members.stop - members.start} members are solved again",
        )
        return None

    def write(self, block: int, kept: Any, failed: np.ndarray) -> None:
        sums = []
        for (file, variable), values in zip(
            self._files(block).items(), [*values_of(kept), failed], strict=True
        ):
            rows = np.ascontiguousarray(values)
            if len(rows) < self.block:  # chunks of one array are equally long
                rows = np.zeros((self.block, *variable.shape), variable.dtype)
                rows[: len(values)] = values
            data = rows.reshape(-1).view(np.uint8).data  # without a copy
            self._write(file, data)
            sums.append(_sha256(data))
        lines = self._record(block, sums)
        self._write(_record_name(block), "\n".join(lines).encode())

    def _sum(self, name: str) -> str:
        try:
            with (self.folder / name).open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except FileNotFoundError:
            return "missing"

    def _write(self, name: str, data: bytes | memoryview) -> None:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as file:
            file.write(data)


def _known(store: Store, block: int) -> np.ndarray | None:
    """Returns `store.failed(block)` as the first process finds it."""

    def find() -> list[np.ndarray] | None:
        failed = store.failed(block)
        return None if failed is None else [failed]

    members = store.members(block)
    size = members.stop - members.start
    found = found_by_first(find, lambda: [np.empty(size, bool)])
    return None if found is None else found[0]


def in_store(
    store: Store, blocks: range, job: Job, meter: diffrax.AbstractProgressMeter
) -> list[int]:
    """Solves blocks of members that the store lacks; returns the failed members."""
    moving, shared = job.batch.split()
    moving, found, progress = in_numpy(moving), [], meter.init()
    for done, block in enumerate(blocks, 1):
        failed = _known(store, block)
        members = store.members(block)
        if failed is None:
            part = jax.tree.map(lambda leaf, m=members: leaf[m], moving)
            size = members.stop - members.start
            some = Batch(eqx.combine(part, shared), job.batch.batched, size)
            kept, failed = in_chunks(job._replace(batch=some), on_device=False)
            if jax.process_index() == 0:
                store.write(block, kept, failed)
        found += (members.start + np.flatnonzero(failed)).tolist()
        progress = meter.step(progress, jnp.asarray(done / len(blocks)))
    meter.close(progress)
    return found
