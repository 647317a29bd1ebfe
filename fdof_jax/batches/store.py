"""Keeps the results of a sweep in a folder, a Zarr group, block by block of members.

A killed process leaves no file in part. Each file of numbers has a checksum, and each
block a digest of its members.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import ClosedJaxpr, Jaxpr
from jaxtyping import PyTree

from ..base.checks import optional_package, refusal
from ..base.user_warnings import warn
from ..base.version import __version__
from ..base.whole_files import whole_file
from ..linkage.linkage import Linkage
from ..linkage.topology import common_unit, names_and_units
from ..simulation.solution import (
    OUTCOMES,
    Solution,
    attributes_in,
    flags,
    outcome_numbers,
)
from .chunks import Common, Job, Outcome, in_chunks, outcome_of

VERSIONS = {"fdof_jax": __version__} | {
    module.__name__: module.__version__ for module in (jax, diffrax, eqx, np)
}
_BYTES = 2**26  # of the results in a block
_CHUNKS = 16  # at most so many in a block, as blocks are what workers share
# Members that are not solved yet, by the kind of the numbers
_FILL = dict(f=np.nan, c=complex(np.nan, np.nan), i=-1, u=0, b=True)
_OF_SAMPLES = dict.fromkeys(("q", "qd", "modes"), ["time", "joint"]) | {
    "taken": ["time"]
}


class Variable(NamedTuple):
    """An array over members; its shape is that of one member."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    dimensions: list[str]
    attributes: Mapping[str, object]


def _is_result(leaf: object) -> bool:
    return isinstance(leaf, diffrax.RESULTS)


def _named(value: PyTree) -> dict[str, PyTree]:
    """Returns the arrays of a member's value, named by their places."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(value, is_leaf=_is_result)
    named, taken = {}, {"failed"}
    for path, leaf in leaves:
        name = re.sub(r"\W+", "_", jax.tree_util.keystr(path)).strip("_") or "value"
        if isinstance(value, Solution):
            name = name.removeprefix("stats_")
        # Some file systems do not tell capitals from small letters.
        if name.casefold() in taken:
            expected = "part names that differ in more than case, none named failed"
            raise refusal("reduce", expected, name)
        taken.add(name.casefold())
        named[name] = leaf
    return named


def _variables(like: PyTree, linkage: Linkage) -> list[Variable]:
    of_motion = isinstance(like, Solution)
    labels = attributes_in(common_unit(names_and_units(linkage.ef)[1]))
    variables = []
    for name, leaf in _named(like).items():
        result = _is_result(leaf)
        dtype, shape = (np.dtype("int8"), ()) if result else (leaf.dtype, leaf.shape)
        if dtype.kind not in _FILL:
            raise refusal("reduce", "numbers of a type that Zarr has", dtype)
        axes = [f"{name}_{axis + 1}" for axis in range(len(shape))]
        if of_motion and name in _OF_SAMPLES:
            axes = _OF_SAMPLES[name]
        elif of_motion and name.startswith("own_"):
            axes[0] = "time"
        own = labels.get(name, {}) if of_motion else {}
        attributes = flags(OUTCOMES) if result else own
        name = "outcome" if of_motion and result else name
        variables.append(Variable(name, dtype, shape, ["member", *axes], attributes))
    return [*variables, Variable("failed", np.dtype(bool), (), ["member"], {})]


class Store:
    """A folder that is a Zarr group, whose chunks along members are blocks.

    No two blocks share a file. The file of `failed` ends a block, after its digest.
    """

    def __init__(self, folder: Path, job: Job, like: PyTree, sweep: str):
        """Writes the metadata of the group, or checks what is there.

        Raises ValueError if the folder holds anything but this sweep.
        """
        zarr = optional_package("zarr", "data")
        self.folder, self.size = folder, job.size
        linkage = eqx.combine(job.moving[0], job.common.shared[0])
        self.variables = _variables(like, linkage)
        each = sum(v.dtype.itemsize * math.prod(v.shape) for v in self.variables)
        most = job.chunk * min(_CHUNKS, max(1, _BYTES // (job.chunk * each)))
        # Nearly equal blocks are solved by the same programs.
        self.block = -(-self.size // -(-self.size // most))
        self.count = -(-self.size // self.block)
        versions = VERSIONS | {"zarr": zarr.__version__}
        attributes = {"versions": versions, "sweep": sweep, "chunk": job.chunk}
        self._refuse_another(attributes)
        files = self._empty(zarr, attributes, linkage, job.common.ts, like)
        for name, data in files.items():
            path = folder / name
            if self._holds(name):
                if path.read_bytes() == data:
                    continue
                expected = f"in {path} the metadata of this sweep"
                self._warn(expected, "something else", "written again")
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as file:
                file.write(data)
        group = zarr.open_group(folder, mode="r+", use_consolidated=False)
        # Numbers that equal the fill value are written, too: no file means not solved.
        everything = {"write_empty_chunks": True}
        self.arrays = [group[v.name].with_config(everything) for v in self.variables]

    def _empty(
        self, zarr: ModuleType, attributes: dict, linkage: Linkage,
        ts: Array | np.ndarray, like: PyTree,
    ) -> dict[str, bytes]:  # fmt: skip
        """Returns the files of the group without members, its own first."""
        memory = {}
        group = zarr.create_group(zarr.storage.MemoryStore(memory))

        def create(name: str, axes: list[str], labels: Mapping, **given: Any) -> None:
            given["compressors"] = [zarr.codecs.Crc32cCodec()]
            group.create_array(name, dimension_names=axes, attributes=labels, **given)

        for v in self.variables:
            create(
                v.name,
                v.dimensions,
                v.attributes,
                shape=(self.size, *v.shape),
                chunks=(self.block, *(max(1, length) for length in v.shape)),
                dtype=v.dtype,
                fill_value=_FILL[v.dtype.kind],
            )
        if isinstance(like, Solution):
            names, units = names_and_units(linkage.ef)
            time = {"long_name": "time", "units": "s"}
            create("time", ["time"], time, data=np.asarray(ts), chunks=ts.shape)
            joint = {"long_name": "joint", "names": names, "units_of_positions": units}
            numbers = np.arange(1, 1 + len(names), dtype="int32")
            create("joint", ["joint"], joint, data=numbers, chunks=numbers.shape)
        files = {name: buffer.to_bytes() for name, buffer in memory.items()}
        # As `zarr.consolidate_metadata` does, which warns. xarray looks for it.
        arrays = {
            name.removesuffix("/zarr.json"): json.loads(data)
            for name, data in files.items()
            if name.endswith("/zarr.json")
        }
        whole = {"kind": "inline", "must_understand": False, "metadata": arrays}
        own = {"attributes": attributes, "consolidated_metadata": whole}
        own = json.loads(files["zarr.json"]) | own
        return files | {"zarr.json": json.dumps(own, indent=1).encode()}

    def _refuse_another(self, attributes: Mapping[str, object]) -> None:
        # In this order, as another worker may be about to write `zarr.json` first.
        endings = ".part", ".partial"  # of files that a killed process leaves
        names = {p.name for p in self.folder.iterdir() if p.suffix not in endings}
        path = self.folder / "zarr.json"
        what = f"holds {min(names)}" if names else ""
        if self._holds("zarr.json"):
            try:
                there = json.loads(path.read_bytes())["attributes"]
                others = [key for key in attributes if there[key] != attributes[key]]
                what = f"has another {', '.join(others)}" if others else ""
            except (ValueError, RecursionError):
                what = ""  # damaged
            except (LookupError, TypeError):
                what = "holds a Zarr group from elsewhere"
        if what:
            raise ValueError(
                "store: expected a new folder or one of this sweep, got "
                f"{self.folder}, which {what}."
            )

    def _warn(self, expected: str, got: str, done: str) -> None:
        message = f"sweep: expected {expected}, got {got}; it is {done}."
        warn(message, RuntimeWarning)

    def members(self, block: int) -> slice:
        return slice(block * self.block, min(self.size, (block + 1) * self.block))

    def failed(self, block: int) -> np.ndarray | None:
        """Returns which members of a finished block failed, or None if it is to solve.

        Warns of damaged files.
        """
        if not self._holds(f"failed/c/{block}"):
            return None
        damage, values = [], []
        for variable, array in zip(self.variables, self.arrays):
            if not array.size:  # without a file
                continue
            parts = variable.name, "c", str(block), *"0" * len(variable.shape)
            file = "/".join(parts)
            if not self._holds(file):
                damage.append(f"{file} missing")
                continue
            try:
                values.append(array.blocks[block])
            except ValueError:  # another checksum
                damage.append(f"{file} damaged")
        file = f"digests/{block}"
        if not self._holds(file):
            damage.append(f"{file} missing")
        elif not damage:
            written = (self.folder / file).read_bytes()
            if written != self._digest(block, values):
                damage.append(f"{file} of other results")
        if damage:
            what = f"in {self.folder} the results of block {block}"
            self._warn(what, ", ".join(damage), "solved again")
            return None
        return values[-1]

    def _digest(self, block: int, values: list[np.ndarray]) -> bytes:
        """Returns a text that names members and their values."""
        digest = hashlib.sha256(repr(self.members(block)).encode())
        for rows in values:
            digest.update(np.ravel(rows).data)
        return digest.hexdigest().encode()

    def _holds(self, file: str) -> bool:
        """Returns whether a file is there; raises ValueError for a folder instead."""
        if (path := self.folder / file).is_dir():
            raise ValueError(f"store: expected a file or none, got the folder {path}.")
        return path.is_file()

    def write(self, block: int, outcome: Outcome) -> None:
        values = [
            outcome_numbers(leaf).astype("int8") if _is_result(leaf) else leaf
            for leaf in jax.tree.leaves(outcome.value, is_leaf=_is_result)
        ]
        rows = [*values, outcome.failed]
        filled = [
            (a, np.asarray(r, a.dtype)) for a, r in zip(self.arrays, rows) if a.size
        ]
        path = self.folder / f"digests/{block}"
        path.parent.mkdir(exist_ok=True)
        with whole_file(path) as file:
            file.write(self._digest(block, [values for _, values in filled]))
        for array, values in filled:
            array.blocks[block] = values


def in_store(
    store: Store, blocks: range, job: Job, meter: diffrax.AbstractProgressMeter
) -> list[int]:
    """Solves the blocks that the store lacks; returns the failed members."""
    failures, progress = [], meter.init()
    for done, block in enumerate(blocks, 1):
        failed = store.failed(block)
        members = store.members(block)
        if failed is None:
            part = jax.tree.map(lambda leaf, m=members: leaf[m], job.moving)
            some = job._replace(moving=part, size=members.stop - members.start)
            outcome = in_chunks(some, on_device=False)
            store.write(block, outcome)
            failed = outcome.failed
        failures += (members.start + np.flatnonzero(failed)).tolist()
        progress = meter.step(progress, np.asarray(done / len(blocks)))
    meter.close(progress)
    return failures


def _constants(program: ClosedJaxpr | Jaxpr) -> Iterator[Array]:
    """Yields the arrays in a program, and in the programs within it.

    Raises ValueError if it calls a Python function, which no digest can name.
    """
    yield from getattr(program, "consts", ())  # an open Jaxpr has none in JAX 0.10
    is_program = lambda leaf: isinstance(leaf, ClosedJaxpr | Jaxpr)
    for operation in program.eqns:
        if operation.primitive.name in ("pure_callback", "io_callback"):
            function = operation.params["callback"].callback_func
            # Run-time checks by equinox add nothing to results.
            if not str(getattr(function, "__module__", "")).startswith("equinox."):
                expected = "a sweep without functions that only Python can call"
                raise refusal("store", expected, function)
        for leaf in jax.tree.leaves(operation.params, is_leaf=is_program):
            if is_program(leaf):
                yield from _constants(leaf)


def outline(moving: PyTree, common: Common) -> tuple[PyTree, str]:
    """Returns shapes and types of a member's value, and the digest of the sweep.

    It covers the program and all arrays, and is the same in every process. Raises
    ValueError for callbacks into Python.
    """
    value = lambda *member: jax.tree.map(jnp.asarray, outcome_of(*member).value)
    first = jax.tree.map(lambda leaf: leaf[0], moving)
    program, arrays, others = eqx.filter_make_jaxpr(value)(common, first)
    # Functions are printed with addresses, which differ between processes.
    text = re.sub(" at 0x[0-9a-f]+", "", str(program))
    digest = hashlib.sha256(text.encode())
    inputs = eqx.filter((moving, common), eqx.is_array_like)
    for leaf in [*_constants(program), *jax.tree.leaves(inputs)]:
        if isinstance(leaf, Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        values = np.ascontiguousarray(leaf)
        digest.update(repr((values.shape, values.dtype)).encode())
        digest.update(values.data.cast("B") if values.size else b"")
    return eqx.combine(arrays, others), digest.hexdigest()
