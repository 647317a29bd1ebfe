"""The devices and processes that chunks run on, whatever devices hold the inputs."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from .array_namespace import in_numpy

_NO_MESH = Mesh(np.empty((), object), ())


@contextlib.contextmanager
def devices_outside_mesh() -> Iterator[list[Any]]:
    """Yields the devices of the mesh that is set, or all, and sets no mesh meanwhile.

    JAX refuses a program with a mesh of its own while another one is set. Before 0.8.1
    it does not tell which is set.
    """
    known = jax.__version_info__ >= (0, 8, 1)
    mesh = jax.sharding.get_mesh() if known else _NO_MESH
    if mesh.empty:
        yield jax.devices()
        return
    with jax.set_mesh(_NO_MESH):
        yield list(mesh.devices.flat)


def found_by_first(
    find: Callable[[], list[np.ndarray] | None], like: Callable[[], list[np.ndarray]]
) -> list[np.ndarray] | None:
    """Returns what `find` returns in the first process, in all of them.

    `like` returns arrays of the same shapes and types, for the other processes.
    """
    if jax.process_count() == 1:
        return find()
    found = find() if jax.process_index() == 0 else None
    send = multihost_utils.broadcast_one_to_all
    if not send(np.asarray(found is not None)):
        return None
    return [np.asarray(array) for array in send(like() if found is None else found)]


def uncommitted(tree: Any) -> Any:
    """Returns `tree` with arrays that were put on chosen devices as NumPy arrays."""

    def released(leaf: Any) -> Any:
        known = isinstance(leaf, jax.Array) and not isinstance(leaf, Tracer)
        if not known or not leaf.committed:
            return leaf
        if not leaf.is_fully_addressable:  # other processes hold parts of it
            leaf = multihost_utils.process_allgather(leaf, tiled=True)
        return in_numpy(leaf)

    return jax.tree.map(released, tree)
