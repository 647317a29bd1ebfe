"""Many motions at once: as `jax.vmap(simulate)`, but faster and in less memory.

Members come in chunks of similar work, so that few wait for a slower one. Very slow
ones are stopped and solved again together.
"""

import contextlib
import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from ..base.checks import (
    array_of,
    function,
    hashable,
    increasing,
    is_transformed,
    real_numbers,
    refusal,
    shown,
    whole_number,
)
from ..base.functions import sharing_functions
from ..base.known_values import in_numpy
from ..base.trees import constant
from ..base.whole_files import folder_path
from ..forces.element import Forces, elements, elements_on
from ..forces.holders import holders
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage
from ..simulation.scene import Scene, accepts_scene
from ..simulation.simulate import solve_options
from ..simulation.solution import Solution
from .batch_axes import Batch, ForcesAxes, batch_of
from .chunks import Common, Job, expected_work, in_chunks, outcome_of
from .devices import devices_outside_mesh
from .store import Store, in_store, outline

_T = TypeVar("_T")
_CHUNK = 256  # twice as many take up to a third longer, as vectors leave the caches
# Steps with joints that are held need more memory, and members more unlike numbers of
# them.
_CHUNK_HELD = 64


def _without_times(_: Scene, solution: Solution) -> Solution:
    return eqx.tree_at(lambda s: s.ts, solution, None)


def _of_member(reduce: Callable) -> Callable:
    """Returns `reduce` if it is a function of two arguments, or raises ValueError."""
    expected = "a function (scene, motion)"
    function("reduce", reduce, expected)
    try:
        inspect.signature(reduce).bind(None, None)
    except TypeError:
        raise refusal("reduce", expected, reduce) from None
    except ValueError:  # a callable that does not tell its arguments
        pass
    return reduce


@eqx.filter_jit  # under `jax.grad` alone, each call would compile its operations again
def _traced(moving: PyTree, common: Common, size: int, chunk: int) -> PyTree:
    """Solves a batch under transformations; failed members enter no derivative."""
    order = jnp.argsort(expected_work(*constant((common, moving))))

    def solved(moving, shared):
        members = common._replace(shared=shared)
        member = lambda moving: outcome_of(members, moving)
        return jax.lax.map(member, moving, batch_size=chunk)

    moving = jax.tree.map(lambda leaf: jnp.asarray(leaf)[order], moving)
    inputs = moving, common.shared
    # A first solve finds the members that fail. In the differentiated solve the first
    # good member replaces them, because NaN would spoil derivatives of shared arrays.
    # Functions may hold traced values too, so that its results are also constant.
    frozen = constant(solved(*constant(inputs)))
    good = ~frozen.failed
    source = jnp.where(good, jnp.arange(size), jnp.argmax(good))
    moving, shared = jax.tree.map(
        lambda a, b: jnp.where(jnp.any(good), a, b) if eqx.is_inexact_array(a) else a,
        *(inputs, constant(inputs)),
    )
    again = solved(jax.tree.map(lambda leaf: leaf[source], moving), shared)
    back = jnp.argsort(order)

    def chosen(a, b):
        return jnp.where(good.reshape(-1, *[1] * (a.ndim - 1)), a, b)[back]

    return jax.tree.map(chosen, again.value, frozen.value)


def _check_elements(batch: Batch) -> None:
    """Raises ValueError unless the force elements suit each member's linkage."""

    def check_member(moving):
        linkage, _, forces = eqx.combine(moving, batch.shared)
        elements_on(linkage, forces)  # what members share is known here

    linkage, _, forces = batch.moving
    if jax.tree.leaves((linkage, forces)):
        jax.eval_shape(jax.vmap(check_member), batch.moving)
    else:
        check_member(batch.moving)


@contextlib.contextmanager
def _naming_axes(
    common: Common, moving: PyTree, forces_axes: ForcesAxes
) -> Iterator[None]:
    """Names `forces_axes` in errors of elements that do not work for one member."""
    try:
        yield
    except TypeError:
        try:
            eqx.filter_eval_shape(expected_work, common, moving)
        except TypeError as error:
            raise TypeError(
                "forces, forces_axes: expected force elements that work for one "
                f"member, got an error with forces_axes={shown(forces_axes)}: {error}"
            ) from error
        raise


@accepts_scene
@jax.transfer_guard("allow")  # its transfers are meant: the batch comes in chunks
def sweep(
    linkage: Linkage,
    state0: State,
    ts: ArrayLike,
    forces: Forces = (),
    *,
    forces_axes: ForcesAxes = None,
    reduce: Callable[[Scene, Solution], PyTree] | None = None,
    chunk: int | None = None,
    throw: bool = False,
    store: str | os.PathLike | None = None,
    shard: int = 0,
    of: int = 1,
    solver: diffrax.AbstractSolver | None = None,
    rtol: ArrayLike | None = None,
    atol: ArrayLike | None = None,
    max_step: ArrayLike | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0: ArrayLike | None = 1e-3,
    adjoint: diffrax.AbstractAdjoint = diffrax.RecursiveCheckpointAdjoint(),
    max_steps: int | None = 65536,
    progress_meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter(),
) -> Any:
    """Computes many motions, as `jax.vmap(simulate)` does, but faster.

    A member that fails ends early with its own result, and a slow one delays few
    others. `sweep` runs on all devices of this process.

    **Arguments:**

    - `linkage`, `state0`: as in `simulate`, any of their arrays with a leading batch
      axis; all members share the others. A `Scene` may stand for linkage, state0 and
      forces: `sweep(scene, ts)`.
    - `ts`: increasing output times of all members, of shape (time,) [s].
    - `forces`: force elements; `forces_axes`: which of their arrays carry the batch
      axis, as `in_axes` of `jax.vmap`: 0 for all, None (the default) for none, or a
      tuple with an entry per element.
    - `reduce`: a function of one member's `Scene` and `Solution`, such as
      `lambda scene, motion: motion.q[-1]`. Only the arrays that it returns are kept.
      Functions of equal code share a program.
    - `chunk`: largest number of members to solve together, per device; by default 256,
      or 64 where elements hold joints.
    - `throw`: whether to raise an error if any member fails.
    - `store`: a folder for the results, which are then not held in memory: a Zarr group
      for `xarray.open_zarr`, in blocks of members (`fdof_jax[data]` installs zarr). A
      repeated call solves only missing or damaged blocks. A folder that holds anything
      else is rejected.
    - `shard`, `of`: with `store`, solves only blocks whose number is `shard` modulo
      `of`. Any number of processes may fill one store.
    - `solver`, `rtol`, `atol`, `max_step`, `stepsize_controller`, `dt0`, `adjoint`,
      `max_steps`, `progress_meter`: as in `simulate`.

    **Returns:** a `Solution` with a leading batch axis everywhere; `result` reports how
    each member ended. With `reduce`, its arrays with that axis: NaN, or a
    `motion.result` among them, marks failed members. With `store`, its path.

    Under `jax.grad` or another transformation a failed member adds nothing to
    derivatives; `solution.result == diffrax.RESULTS.successful` selects the others.
    Finding failed members takes one more solve.

    **Raises:** ValueError for malformed arguments; RuntimeError, with `throw=True`, if
    a member fails; ImportError, with `store`, where zarr is not installed. Warns of
    damaged files.
    """
    # Arrays may be on any devices; chunks of them go to those of the sweep.
    linkage, state0, forces = in_numpy((linkage, state0, forces))
    try:
        q, qd = map(array_of, state0)
    except (TypeError, ValueError):
        raise refusal("state0", "a State(q, qd)", state0) from None
    ts = real_numbers("ts", ts, (None,))
    # Other kinds than real numbers are refused by `batch_of`.
    other = lambda a: a.dtype != ts.dtype and a.dtype.kind in "iuf"
    state0 = State(*(a.astype(ts.dtype) if other(a) else a for a in (q, qd)))
    increasing("ts", ts)
    elements("forces", forces)
    hashable("forces", forces)
    hashable("reduce", reduce)
    most = _CHUNK_HELD if holders(forces) else _CHUNK
    chunk = most if chunk is None else whole_number("chunk", chunk, 1)
    of, shard = whole_number("of", of, 1), whole_number("shard", shard, 0)
    if shard >= of:
        raise refusal("shard", f"a whole number below of={of}", shard)
    if store is None and of > 1:
        raise refusal("store", "a folder, because `of` is given", store)
    settings = solve_options(
        solver=solver,
        rtol=rtol,
        atol=atol,
        max_step=max_step,
        stepsize_controller=stepsize_controller,
        dt0=dt0,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=throw,
        progress_meter=progress_meter,
    )
    del settings["progress_meter"]  # it counts finished members, not time
    batch = batch_of(linkage, state0, forces, forces_axes)
    moving, shared, size = batch
    if forces:
        _check_elements(batch)
    keep = _without_times if reduce is None else _of_member(reduce)
    common = Common(shared, ts, settings, keep)
    traced = is_transformed()
    if traced and (throw or store is not None):
        raise ValueError(
            "throw, store: expected their defaults under jit, grad or vmap."
        )
    folder: Any = None if store is None else folder_path("store", store)

    def fill(job: Job) -> list[int]:
        group = Store(folder, job, *outline(moving, common))
        return in_store(group, range(shard, group.count, of), job, progress_meter)

    def solved(solve: Callable[[Job], _T]) -> _T:
        def run(forces, reduce):
            kept = keep if reduce is None else reduce
            own = Common((*shared[:2], forces), ts, settings, kept)
            return solve(Job(moving, own, size, chunk, devices))

        with devices_outside_mesh() as devices:
            return sharing_functions(run, forces=shared[2], reduce=reduce)

    value: PyTree = None
    failures: Sequence[int] | np.ndarray = []
    with _naming_axes(common, moving, forces_axes):
        if traced:
            value = _traced(moving, common, size, chunk)
        elif folder is not None:
            failures = solved(fill)
        else:
            # To look up the methods of any meter takes 0.1 ms.
            silent = type(progress_meter) is diffrax.NoProgressMeter
            meter = None if silent else progress_meter
            outcome = solved(lambda job: in_chunks(job, meter))
            value, failures = outcome.value, np.flatnonzero(outcome.failed)
    if throw and len(failures):
        raise RuntimeError(
            f"sweep: {len(failures)} of {size} members failed, the first of "
            f"them member {failures[0]}."
        )
    if folder is not None:
        return folder
    if reduce is not None:
        return value
    # NumPy's view of the common times is no copy of them for each member.
    times = (jnp if traced else np).broadcast_to(ts, (size, *ts.shape))
    # To make a new `Solution` takes 0.05 ms more.
    (_, *others), structure = jax.tree.flatten(value, is_leaf=lambda x: x is None)
    return structure.unflatten([times, *others])
