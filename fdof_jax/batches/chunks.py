"""Solves a batch in chunks of members that take about equally long."""

import contextlib
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import diffrax
import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh

from ..base.known_values import in_numpy
from ..simulation.solution import Solution
from .batch_axes import Batch
from .chunk_programs import compiled, expected_work, form_of, lowered

_SMALL = 8  # lanes of the chunks for a few slow members
_COPIED_AT_ONCE = 2**24  # bytes to a device
_FORECASTS = 1024  # computed at once
_NO_MESH = Mesh(np.empty((), object), ())


def _cores() -> int:
    """Returns the number of cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def devices_outside_mesh() -> Iterator[list[Any]]:
    """Yields this process's devices, of the mesh that is set or all; None if just one.

    Meanwhile no mesh is set: its devices would share each program. Before 0.8.1 JAX
    does not say which is set.
    """
    set_mesh = jax.__version_info__ >= (0, 8, 1)
    mesh = jax.sharding.get_mesh() if set_mesh else _NO_MESH
    devices = jax.local_devices() if mesh.empty else list(mesh.local_devices)
    with contextlib.nullcontext() if mesh.empty else jax.set_mesh(_NO_MESH):
        yield devices if len(devices) > 1 or not mesh.empty else [None]


class Job(NamedTuple):
    """What a sweep solves, on which devices, and the most members of a chunk."""

    batch: Batch
    ts: Array
    settings: dict
    reduce: Callable[[Solution], Any]
    chunk: int
    devices: list[Any]


def _lanes(members: int, chunk: int) -> int:
    """Returns the number of lanes for some members: few numbers serve all batches."""
    if members == 1:
        return 1
    return min(chunk, max(_SMALL, 1 << (members - 1).bit_length()))


def _forecast(job: Job, moving: Any, shared: Any) -> np.ndarray:
    """Returns the `expected_work` of all members; one program serves any number."""
    work = []
    for first in range(0, job.batch.size, _FORECASTS):
        rows = np.arange(first, first + _FORECASTS)
        rows = np.minimum(rows, job.batch.size - 1)
        some = jax.tree.map(lambda leaf, rows=rows: leaf[rows], moving)
        work.append(expected_work(job.ts, some, shared))
    return np.concatenate(work)[: job.batch.size]


def _solve(program: Any, *arguments: Any) -> Any:
    return jax.block_until_ready(program(*arguments))


def _outcomes(
    job: Job, moving: Any, rest: Any, members: np.ndarray, lanes: int
) -> Iterator[tuple[np.ndarray, Any]]:
    """Solves members in chunks; yields members and their outcomes."""
    chunks = [members[i : i + lanes] for i in range(0, len(members), lanes)]
    devices = job.devices
    # XLA splits operations among the cores, which gains little for a chunk, and runs in
    # turn what one thread sends. While it runs, Python may do other things.
    if len(devices) == 1 and jax.default_backend() == "cpu":
        devices = devices * _cores()
    devices = devices[: len(chunks)]
    form, arrays = form_of(moving, lanes, rest)
    leaves = jax.tree.leaves(moving)

    def rows_of(members: np.ndarray) -> list[np.ndarray]:
        rows = np.append(members, np.full(lanes - len(members), members[-1]))
        return [leaf[rows] for leaf in leaves]

    # Traces and transfers depend on settings that no other thread has.
    programs = [lowered(form, device) for device in devices]
    if devices == [None]:
        program = compiled(programs[0])
        for some in chunks:
            yield some, _solve(program, rows_of(some), arrays)
        return
    shared = [jax.device_put(arrays, device) for device in devices]
    running: deque[tuple[np.ndarray, Future]] = deque()
    with ThreadPoolExecutor(len(devices)) as pool:
        different = dict.fromkeys(programs)  # cores have one program in common
        different = dict(zip(different, pool.map(compiled, different)))
        for number, some in enumerate(chunks):
            worker = number % len(devices)
            own = jax.device_put(rows_of(some), devices[worker])
            program = different[programs[worker]]
            running.append((some, pool.submit(_solve, program, own, shared[worker])))
            if len(running) > 2 * len(devices):
                some, future = running.popleft()
                yield some, future.result()
        for some, future in running:
            yield some, future.result()


def in_chunks(
    job: Job,
    meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter(),
    on_device: bool = True,
) -> tuple[Any, np.ndarray]:
    """Returns what is kept of all members, and which of them failed.

    Unless `on_device`, the arrays are NumPy's.
    """
    size = job.batch.size
    moving, shared = job.batch.split()
    moving = in_numpy(moving)  # NumPy cuts faster
    rest = job.settings, job.reduce, job.ts, shared
    lanes = _lanes(-(-size // len(job.devices)), job.chunk)
    order = np.arange(size)
    if size > lanes:
        # The longest come first, so that no core waits long for another at the end.
        order = np.argsort(_forecast(job, moving, shared))[::-1]
    place = np.arange(size)  # of members in the results
    if on_device:  # in the order in which they come: faster, and more memory
        place[order] = np.arange(size)
    done, results, structure, waiting = 0, [], None, order
    progress = meter.init()
    while len(waiting):
        late = []
        for members, outcomes in _outcomes(job, moving, rest, waiting, lanes):
            _, stopped, _ = outcomes
            late.append(members[np.asarray(stopped)[: len(members)]])
            values, structure = jax.tree.flatten(outcomes)
            if len(members) == size == lanes and not len(late[-1]):
                results = values  # a single chunk, in order
            elif not results:
                results = [np.empty((size, *v.shape[1:]), v.dtype) for v in values]
            if results is not values:
                rows = place[members]
                if rows[-1] - rows[0] == len(rows) - 1:  # a slice is faster
                    rows = slice(rows[0], rows[-1] + 1)
                for result, value in zip(results, values):
                    result[rows] = np.asarray(value)[: len(members)]
            done += len(members) - len(late[-1])
            progress = meter.step(progress, np.asarray(done / size))
        waiting = np.concatenate(late)
        if 0 < len(waiting) <= lanes // _SMALL:
            lanes = _lanes(min(len(waiting), _SMALL), job.chunk)
    meter.close(progress)
    if on_device:
        for index, leaf in enumerate(results):
            if isinstance(leaf, np.ndarray):
                results[index] = leaf[place]
            if leaf.nbytes > _COPIED_AT_ONCE:  # frees one before the next is copied
                results[index] = jax.device_put(results[index])
        results = jax.device_put(results)
    kept, _, failed = jax.tree.unflatten(structure, results)
    return kept, np.asarray(failed)
