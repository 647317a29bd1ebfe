"""Many motions at once: as `jax.vmap(simulate)`, but faster and in less memory.

A vectorised adaptive solve runs until its slowest member is done. `sweep` orders the
members by expected work and cuts them into chunks of one shape. A member that takes
many more steps than its neighbours is stopped and solved again later, in a smaller
batch of slow members.
"""

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ..base.checks import (
    function,
    hashable,
    increasing,
    is_traced,
    is_transformed,
    numpy_array,
    real_array,
    refusal,
    shown,
    whole_number,
)
from ..base.functions import sharing_functions
from ..base.known_values import in_numpy
from ..base.whole_files import folder_path
from ..forces.element import Forces, elements, elements_on
from ..linkage.coordinates import State
from ..linkage.linkage import Linkage
from ..simulation.scene import accepts_scene
from ..simulation.simulate import solve_options
from ..simulation.solution import Solution
from ..steps.dopri8 import constant
from .batch_axes import Batch, batch_of
from .chunk_programs import expected_work, outcome_of
from .chunks import Job, devices_outside_mesh, in_chunks
from .store import Store, in_store, outline

_CHUNK = 512  # half as many take 15 % longer on two cores: each call costs 0.5 ms


def _without_times(solution: Solution) -> Solution:
    """Leaves out the output times, which all members have in common."""
    return eqx.tree_at(lambda s: s.ts, solution, None)


@eqx.filter_jit  # under `jax.grad` alone, each call would compile its operations again
def _traced(
    batch: Batch,
    ts: Array,
    settings: dict,
    reduce: Callable[[Solution], Any],
    chunk: int,
) -> Any:
    """Solves a batch under transformations; failed members enter no derivative."""
    moving, shared = batch.split()
    order = jnp.argsort(expected_work(*constant((ts, moving, shared))))

    def solved(moving, shared):
        return jax.lax.map(
            lambda member: outcome_of(settings, reduce, ts, member, shared, False),
            moving,
            batch_size=chunk,
        )

    moving = jax.tree.map(lambda leaf: jnp.asarray(leaf)[order], moving)
    # A first solve finds the members that fail. In the differentiated solve the first
    # good member replaces them, because NaN would spoil derivatives of shared arrays.
    # Functions may hold traced values too, so that its results are also constant.
    frozen, _, failed = constant(solved(*constant((moving, shared))))
    good = ~failed
    source = jnp.where(good, jnp.arange(batch.size), jnp.argmax(good))
    moving, shared = jax.tree.map(
        lambda a, b: jnp.where(jnp.any(good), a, b) if eqx.is_inexact_array(a) else a,
        *((moving, shared), constant((moving, shared))),
    )
    again, _, _ = solved(jax.tree.map(lambda leaf: leaf[source], moving), shared)
    back = jnp.argsort(order)

    def chosen(a, b):
        return jnp.where(good.reshape(-1, *[1] * (a.ndim - 1)), a, b)[back]

    return jax.tree.map(chosen, again, frozen)


def _check_elements(batch: Batch, ts: Array, forces_axes: Any) -> None:
    """Raises an error unless the force elements suit each member's linkage."""
    moving, shared = batch.split()

    def check_member(moving):
        linkage, _, forces = eqx.combine(moving, shared)
        elements_on(linkage, forces)  # what members share is known here

    eqx.filter_eval_shape(eqx.filter_vmap(check_member), moving)
    try:
        eqx.filter_eval_shape(expected_work, ts, moving, shared)
    except TypeError as error:
        raise TypeError(
            "forces, forces_axes: expected force elements that work for one member, "
            f"got an error with forces_axes={shown(forces_axes)}: {error}"
        ) from error


@accepts_scene
@jax.transfer_guard("allow")  # its transfers are meant: the batch comes in chunks
def sweep(
    linkage: Linkage,
    state0: State,
    ts: ArrayLike,
    forces: Forces = (),
    *,
    forces_axes: Any = None,
    reduce: Callable[[Solution], Any] | None = None,
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

    A member that fails ends early with a result of its own, and slow members delay few
    others. Runs on all devices of this process.

    **Arguments:**

    - `linkage`, `state0`: as in `simulate`, any of their arrays with a leading batch
      axis; arrays without it are shared by all members. A `Scene` may stand for
      linkage, state0 and forces: `sweep(scene, ts)`.
    - `ts`: increasing output times, common to all members, of shape (time,) [s].
    - `forces`: force elements; `forces_axes`: which of their arrays carry the batch
      axis, as `in_axes` of `jax.vmap`: 0 for all, None (the default) for none, or a
      tuple of these with one entry per element.
    - `reduce`: a function of one member's `Solution`, for instance
      `lambda motion: motion.q[-1]`; of each member only the arrays that it returns are
      kept. Functions of equal code share a compiled program.
    - `chunk`: largest number of members to solve together, per device; None stands for
      512.
    - `throw`: whether to raise an error if any member fails.
    - `store`: a folder for the results, which are not held in memory: a Zarr group for
      `xarray.open_zarr`, written in blocks of members (`fdof_jax[data]` brings zarr). A
      repeated call solves only the blocks that are missing or damaged; a warning names
      damaged files. A folder with another sweep, or anything else, is refused.
    - `shard`, `of`: with `store`, solves only each block whose number is `shard` modulo
      `of`. Any number of processes may fill one store, in any order.
    - `solver`, `rtol`, `atol`, `max_step`, `stepsize_controller`, `dt0`, `adjoint`,
      `max_steps`, `progress_meter`: as in `simulate`.

    **Returns:** a `Solution` with a leading batch axis everywhere; `result` reports how
    each member ended. With `reduce`, what that returns, with a leading batch axis:
    NaN, or a `motion.result` in it, marks members that failed. Under `jax.grad` or
    another transformation a failed member adds nothing to any derivative, and
    `solution.result == diffrax.RESULTS.successful` selects the members that count.
    Finding them takes one more solve, without derivatives. With `store`, its path.

    **Raises:** ValueError for malformed arguments; RuntimeError, with `throw=True`, if
    a member fails; ImportError, with `store`, where zarr is not installed.
    """
    # Arrays may be on any devices; chunks of them go to those of the sweep.
    linkage, state0, forces = in_numpy((linkage, state0, forces))
    try:
        q, qd = (jnp.asarray(a) if is_traced(a) else numpy_array(a) for a in state0)
    except (TypeError, ValueError):
        raise ValueError(
            f"state0: expected a State(q, qd), got {shown(state0)}."
        ) from None
    ts = real_array("ts", ts, (None,))
    # Other kinds than real numbers are refused by `batch_of`.
    other = lambda a: a.dtype != ts.dtype and a.dtype.kind in "iuf"
    state0 = State(*(a.astype(ts.dtype) if other(a) else a for a in (q, qd)))
    increasing("ts", ts)
    elements("forces", forces)
    hashable("forces", forces)
    hashable("reduce", reduce)
    chunk = _CHUNK if chunk is None else whole_number("chunk", chunk, 1)
    whole_number("of", of, 1)
    if whole_number("shard", shard, 0) >= of:
        raise refusal("shard", f"a whole number below of={of}", shard)
    if store is None and of > 1:
        raise refusal("store", "a folder, as of is given", store)
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
    traced = is_transformed()
    if forces:
        _check_elements(batch, ts, forces_axes)
    keep = _without_times if reduce is None else function("reduce", reduce)

    def check(failed: Sequence[int] | np.ndarray) -> None:
        if throw and len(failed):
            raise RuntimeError(
                f"sweep: {len(failed)} of {batch.size} members failed, the first of "
                f"them member {failed[0]}."
            )

    def whole(kept: Any) -> Any:
        if reduce is not None:
            return kept
        # NumPy's view of the common times is no copy of them for each member.
        times = (jnp if traced else np).broadcast_to(ts, (batch.size, *ts.shape))
        return dataclasses.replace(kept, ts=times)

    if traced:
        if throw or store is not None:
            raise ValueError(
                "throw, store: expected their defaults under jit, grad or vmap."
            )
        return whole(_traced(batch, ts, settings, keep, chunk))
    with devices_outside_mesh() as devices:
        solved = lambda solve: sharing_functions(
            lambda forces, reduce: solve(
                Job(batch.with_forces(forces), ts, settings, reduce, chunk, devices)
            ),
            forces=batch.inputs[2],
            reduce=keep,
        )
        if store is not None:
            folder = folder_path("store", store)
            like, digest = outline(batch, ts, settings, keep)
            group = Store(folder, batch, ts, like, chunk, digest)
            blocks = range(shard, group.count, of)
            check(solved(lambda job: in_store(group, blocks, job, progress_meter)))
            return folder
        kept, failed = solved(lambda job: in_chunks(job, progress_meter))
    check(np.flatnonzero(failed))
    return whole(kept)
