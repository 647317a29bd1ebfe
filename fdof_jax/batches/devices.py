"""The devices that solve the chunks of a batch, and their programs.

On CPU, XLA's threads wait for each other, so a chunk gains nothing by several. Here
each core has a client of XLA with a single thread.
"""

import contextlib
import functools
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax._src.lib import xla_client  # pyright: ignore[reportPrivateImportUsage]
from jax.experimental import serialize_executable
from jax.sharding import Mesh
from jaxtyping import PyTree

from ..base.configuration import wide_vectors

Device = Any  # a `jax.Device`, or None for the default one

_NO_MESH = Mesh(np.empty((), object), ())
_THREADS = "NPROC"  # of a client of XLA, which reads it when it starts


def cores() -> int:
    """Returns the number of cores for this process."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def device_of_core(number: int) -> Device:
    """Returns a device with one thread, to which the system gives a core."""
    before = os.environ.get(_THREADS)
    os.environ[_THREADS] = "1"
    try:
        return xla_client.make_cpu_client(num_devices=1).devices()[0]
    finally:
        del os.environ[_THREADS]
        if before is not None:
            os.environ[_THREADS] = before


def of_cores(devices: list[Device]) -> list[Device]:
    """Returns the devices, or one per core in place of a CPU's only one."""
    if devices != [None] or jax.default_backend() != "cpu" or cores() == 1:
        return devices
    return [device_of_core(number) for number in range(cores())]


@contextlib.contextmanager
def devices_outside_mesh() -> Iterator[list[Device]]:
    """Yields the devices of the mesh that is set, else all of this process.

    They are [None], the default device, if there is only one. Meanwhile no mesh is set,
    whose devices would share each program.
    """
    mesh = jax.sharding.get_mesh()
    devices = jax.local_devices() if mesh.empty else list(mesh.local_devices)
    with contextlib.nullcontext() if mesh.empty else jax.set_mesh(_NO_MESH):
        yield devices if len(devices) > 1 or not mesh.empty else [None]


@functools.lru_cache(maxsize=64)
def compiled(program: jax.stages.Lowered) -> jax.stages.Compiled:
    return program.compile(wide_vectors())


@functools.lru_cache(maxsize=256)
def copied(program: jax.stages.Compiled, device: Device) -> jax.stages.Compiled | None:
    """Returns a program for another CPU device, uncompiled; None if that cannot be.

    Programs that call Python cannot be copied. Those from JAX's cache lack parts.
    """
    if jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return None
    try:
        copy = serialize_executable.serialize(program)
    except (AttributeError, pickle.PicklingError):
        return None
    return serialize_executable.deserialize_and_load(
        *copy, backend=device.client, execution_devices=[device]
    )


@functools.cache
def thread_of(device: Device) -> ThreadPoolExecutor:
    """Returns the thread that calls a device's programs.

    Calls from two threads would wait for each other, and a new thread for a core.
    """
    return ThreadPoolExecutor(1)


def in_place(arrays: PyTree, device: Device) -> PyTree:
    """Puts arrays on a device, except NumPy's, which a call transfers faster."""
    put = lambda a: a if isinstance(a, np.ndarray) else jax.device_put(a, device)
    return jax.tree.map(put, arrays)


def solve(program: jax.stages.Compiled, *arguments: PyTree) -> PyTree:
    """Calls a program and waits for its results."""
    return jax.block_until_ready(program(*arguments))


def in_thread(function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """Calls a function in a thread, which may not know of the caller's precision."""
    with jax.enable_x64(True), jax.transfer_guard("allow"):
        return function(*arguments)
