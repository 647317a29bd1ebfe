"""Solves a batch in chunks of members that take about equally long."""

import functools
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import diffrax
import jax
import numpy as np
from jax import Array
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding

from ..base.array_namespace import in_numpy
from ..base.devices import found_by_first
from ..simulation.solution import Solution
from .batch_axes import Batch
from .checkpoints import Checkpoint, Rows
from .chunk_programs import Form, compiled, traced, work_of_chunks

_SMALL = 8  # lanes of the chunks for a few slow members
_MOST = 8  # chunks that one call of a program solves, one after another
_STATES = 2**18  # at output times, of all members of such a call
_COPIED_AT_ONCE = 2**24  # bytes of results; of more, each array is copied alone


def _cores() -> int:
    """Returns the number of cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def usual_chunk(*, anywhere: bool) -> int:
    """Returns the lanes of a chunk; `anywhere`: the same on every machine."""
    # One core is fastest with 128. XLA splits operations among several, and what that
    # costs pays only with more lanes.
    several = jax.default_backend() == "cpu" and _cores() > 1
    return 256 if several and not anywhere else 128


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, Array | np.ndarray)


def _of_jax(leaf: Any) -> Array:
    return leaf if isinstance(leaf, Array) else jax.device_put(leaf)


def _canonical(leaf: Any) -> Array | np.ndarray:
    """Returns the array in the dtype that JAX would give it."""
    if isinstance(leaf, Array):
        return leaf
    return np.asarray(leaf, jax.dtypes.canonicalize_dtype(leaf.dtype))


def _parted(tree: Any) -> tuple[list[Array], Any, tuple[Any, ...]]:
    """Returns the arrays of a tree, its structure, and its leaves, None for arrays."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [_of_jax(leaf) for leaf in leaves if _is_array(leaf)]
    return arrays, structure, tuple(None if _is_array(x) else x for x in leaves)


def _shared_out(rows: np.ndarray, sharding: NamedSharding) -> Array:
    return jax.make_array_from_callback(rows.shape, sharding, rows.__getitem__)


def _solve(program: Any, *arguments: Any) -> Any:
    return jax.block_until_ready(program(*arguments))


class Job(NamedTuple):
    """What a sweep solves, on which devices, and the most members of a chunk."""

    batch: Batch
    ts: Array
    settings: dict
    reduce: Callable[[Solution], Any]
    chunk: int
    devices: list[Any]


class _Chunks:
    """Solves chunks, and keeps their results in a checkpoint if there is one."""

    def __init__(self, job: Job, checkpoint: Checkpoint | None, apart: bool):
        """Prepares a batch; `apart`: whether each call is to solve a single chunk."""
        batch, ts, settings, reduce, _, devices = job
        self.devices = len(devices)
        mesh = Mesh(np.array(devices), ("member",)) if len(devices) > 1 else None
        moving, shared = batch.split()
        moving, structure = jax.tree.flatten(moving)
        self.arrays, rest, constants = _parted((settings, reduce, ts, shared))
        self.moving = in_numpy(list(map(_canonical, moving)))  # NumPy cuts faster
        self.form = Form(structure, rest, constants, ((), ()), 1, mesh)
        self.checkpoint = checkpoint
        self.apart = apart or checkpoint is not None
        self.size = batch.size
        self.times = len(ts)

    def solve(
        self, form: Form, members: np.ndarray
    ) -> Iterator[tuple[np.ndarray, list[Any], Any]]:
        """Solves members in chunks, by a program of this form.

        Returns members, the arrays of their outcomes, and the outcomes' structure.
        """
        size = form.lanes
        chunks = [members[i : i + size] for i in range(0, len(members), size)]
        # XLA splits operations among the cores, which gains little for a chunk, and
        # runs in turn what one thread sends. While it runs, Python may do other things.
        threads = self.form.mesh is None and jax.default_backend() == "cpu"
        workers = min(_cores(), len(chunks)) if threads else 1
        if not self.apart:
            calls = workers * -(-len(chunks) // (workers * form.series))
            calls = min(calls, len(chunks))
            # Each call gets chunks of all lengths, so that all take equally long.
            chunks = [np.concatenate(chunks[i::calls]) for i in range(calls)]
        if workers == 1:
            yield from (self._begin(form, members, None)() for members in chunks)
            return
        with ThreadPoolExecutor(workers) as pool:
            running = deque()
            for members in chunks:
                running.append(self._begin(form, members, pool))
                if len(running) > 2 * workers:
                    yield running.popleft()()
            while running:
                yield running.popleft()()

    def forecast(self, ts: Array, shared: Any, lanes: int) -> np.ndarray:
        """Returns the `expected_work` of all members; one program serves any number."""
        size, rows = self.size, _MOST * lanes
        arrays, rest, constants = _parted((ts, shared))
        kinds = self._kinds(rows, arrays)
        form = Form(self.form.moving, rest, constants, kinds, _MOST, None)
        work = []
        for first in range(0, size, rows):
            block = np.minimum(np.arange(first, first + rows), size - 1)
            moving = [leaf[block] for leaf in self.moving]
            count = np.int32(-(-min(rows, size - first) // lanes))
            work.append(work_of_chunks(form)(count, moving, arrays))
        return np.concatenate(work)[:size]

    def _kinds(self, rows: int, arrays: list[Array]) -> tuple[Any, Any]:
        moving = tuple(((rows, *leaf.shape[1:]), leaf.dtype) for leaf in self.moving)
        return moving, tuple((a.shape, a.dtype, a.weak_type) for a in arrays)

    def form_of(self, lanes: int, several: bool) -> Form:
        """Returns the form of a program for one or several chunks of so many lanes."""
        lanes *= self.devices
        series = 1
        if several and self.form.mesh is None:
            series = max(1, min(_MOST, _STATES // (lanes * self.times)))
        kinds = self._kinds(series * lanes, self.arrays)
        return self.form._replace(kinds=kinds, series=series)

    def _begin(
        self, form: Form, members: np.ndarray, pool: ThreadPoolExecutor | None
    ) -> Callable[[], tuple[np.ndarray, list[Any], Any]]:
        """Begins to solve chunks; returns a function that waits for the outcomes."""
        kept = self._kept(form, members)
        if kept is not None:
            return lambda: kept
        count = np.int32(-(-len(members) // form.lanes))
        padded = np.full(form.series * form.lanes, members[-1])
        padded[: len(members)] = members
        chosen = np.arange(form.rows, dtype=np.int32)
        if len(members) == self.size and not self.apart and form.mesh is None:
            # Outcomes in the order of the batch need not be sorted, and copied, here.
            chosen[members] = np.arange(self.size)
            members = np.arange(self.size)
        moving = [leaf[padded] for leaf in self.moving]
        if form.sharding is not None:
            moving = [_shared_out(leaf, form.sharding) for leaf in moving]
        elif pool is not None:  # whose threads do not inherit this one's settings
            count, chosen, moving = jax.device_put((count, chosen, moving))
        given = count, chosen, moving, self.arrays
        work = functools.partial(_solve, compiled(form), *given)
        outcomes = work if pool is None else pool.submit(work).result
        return lambda: self._end(form, members, outcomes())

    def _end(
        self, form: Form, members: np.ndarray, outcomes: Any
    ) -> tuple[np.ndarray, list[Any], Any]:
        values, structure = jax.tree.flatten(outcomes)
        if jax.process_count() > 1:
            values = multihost_utils.process_allgather(values, tiled=True)
        if form.mesh is not None or len(members) < form.series * form.lanes:
            values = [np.asarray(leaf)[: len(members)] for leaf in values]
        if self.checkpoint is not None and jax.process_index() == 0:
            values = [np.asarray(leaf) for leaf in values]
            self.checkpoint.write(members, form.lanes, values)
        return members, values, structure

    def _kept(self, form: Form, members: np.ndarray) -> Any:
        """Returns the outcomes of a chunk that the checkpoint holds, or None."""
        checkpoint, size = self.checkpoint, len(members)
        if checkpoint is None:
            return None

        def rows() -> Rows:
            return Rows(jax.tree.leaves(traced(form).out_info))

        def find() -> list[np.ndarray] | None:
            known = checkpoint.has(members, form.lanes)
            return checkpoint.read(members, form.lanes, rows()) if known else None

        values = found_by_first(find, lambda: rows().empty(size))
        structure = jax.tree.structure(traced(form).out_info)
        return None if values is None else (members, values, structure)


def _lanes(members: int, chunk: int) -> int:
    """Returns the number of lanes for some members: few numbers serve all batches."""
    if members == 1:
        return 1
    return min(chunk, max(_SMALL, 1 << (members - 1).bit_length()))


def _to_device(results: list[Any]) -> None:
    """Replaces NumPy arrays by JAX's."""
    if sum(leaf.nbytes for leaf in results) < _COPIED_AT_ONCE:
        results[:] = jax.device_put(results)
    else:
        for index, leaf in enumerate(results):
            results[index] = jax.device_put(leaf)  # frees one before the next is copied


def in_chunks(
    job: Job,
    checkpoint: Checkpoint | None = None,
    meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter(),
    on_device: bool = True,
) -> tuple[Any, np.ndarray]:
    """Returns what is kept of all members, and which of them failed.

    Unless `on_device`, the arrays of several chunks are NumPy's.
    """
    batch, chunk = job.batch, job.chunk
    seen = type(meter) is not diffrax.NoProgressMeter
    chunks = _Chunks(job, checkpoint, seen)
    lanes = _lanes(-(-batch.size // chunks.devices), chunk)
    everyone = waiting = np.arange(batch.size)
    several = batch.size > lanes * chunks.devices
    form = chunks.form_of(lanes, several)
    if several:
        # The longest come first, so that no core waits long for another at the end.
        _, shared = batch.split()
        waiting = np.argsort(chunks.forecast(job.ts, shared, lanes))[::-1]
    done, results, structure = 0, [], None
    progress = meter.init() if seen else None
    while len(waiting):
        late = []
        for members, values, structure in chunks.solve(form, waiting):
            _, stopped, _ = jax.tree.unflatten(structure, values)
            late.append(members[np.asarray(stopped)])
            if np.array_equal(members, everyone) and not len(late[-1]):
                results = values  # nothing is to be sorted or added
            else:
                if not results:
                    results = [
                        np.empty((batch.size, *v.shape[1:]), v.dtype) for v in values
                    ]
                for kept, value in zip(results, values):
                    kept[members] = value
            done += len(members) - len(late[-1])
            if seen:
                progress = meter.step(progress, np.asarray(done / batch.size))
        waiting = np.concatenate(late)
        if 0 < len(waiting) <= lanes // _SMALL:
            form = chunks.form_of(_lanes(min(len(waiting), _SMALL), chunk), False)
    if seen:
        meter.close(progress)
    if on_device and not all(isinstance(leaf, Array) for leaf in results):
        _to_device(results)
    kept, _, failed = jax.tree.unflatten(structure, results)
    return kept, np.asarray(failed)
