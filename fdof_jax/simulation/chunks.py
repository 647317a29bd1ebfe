"""Solves a batch in chunks of members that take about equally long."""

import re
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ..checks import refusal
from ..dynamics import forward_dynamics
from ..forces.element import elements
from ..linkage.topology import real_joints
from ..xla.array_namespace import in_numpy
from .batch_axes import Batch
from .checkpoints import Checkpoint, Rows
from .field import element_effort
from .simulate import simulate
from .solution import Solution
from .step_wrappers import Limited
from .steps import default_controller

_FIRST_LIMIT = 256  # limit of steps in the first chunk
_SLACK = 2.0  # a member may take this many times the steps of most others
_SMALL = 8  # lanes of the chunks for a few slow members


def _adaptive(settings: dict) -> bool:
    controller = settings["stepsize_controller"] or default_controller()
    return isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)


def motion_of(
    settings: dict, ts: Array, moving: Any, shared: Any, limit: Array | None
) -> Solution:
    """Computes one member's motion, with a limit of adaptive steps if it is given."""
    linkage, state0, forces = eqx.combine(moving, shared)
    if limit is not None and _adaptive(settings):
        inner = settings["stepsize_controller"] or default_controller()
        limited = Limited(inner, limit)  # pyright: ignore[reportCallIssue]
        settings = settings | {"stepsize_controller": limited}
    return simulate(linkage, state0, ts, forces, throw=False, **settings)


def outcome_of(
    settings: dict,
    reduce: Callable[[Solution], Any],
    ts: Array,
    moving: Any,
    shared: Any,
    limit: Array | None,
) -> tuple[Any, Array, Array]:
    """Computes what is kept of one member, its steps, and whether it failed."""
    solution = motion_of(settings, ts, moving, shared, limit)
    kept = reduce(solution)
    if not all(map(eqx.is_array_like, jax.tree.leaves(kept))):
        raise refusal("reduce", "a function that returns arrays", kept)
    failed = solution.result != diffrax.RESULTS.successful
    return kept, solution.stats["num_steps"], failed


@eqx.filter_jit
def _solve_chunk(settings, mesh, reduce, ts, moving, shared, limit):
    arrays, static = eqx.partition((reduce, ts, shared, limit), eqx.is_array)

    def run(moving, arrays):
        reduce, ts, shared, limit = eqx.combine(arrays, static)
        member = lambda m: outcome_of(settings, reduce, ts, m, shared, limit)
        return jax.vmap(member)(moving)

    if mesh is not None:
        lanes, same = PartitionSpec("member"), PartitionSpec()
        # Each device loops only until its own slowest member is done.
        run = jax.shard_map(
            run,
            mesh=mesh,
            in_specs=(lanes, same),
            out_specs=lanes,
            check_vma=False,
        )
    return run(moving, arrays)


@eqx.filter_jit
def expected_work(t0: Array, moving: Any, shared: Any) -> tuple[Array, Array]:
    """Computes each member's topology and a rate [1/s] that grows with its steps.

    The rate combines the joints' initial rates and accelerations.
    """

    def member(moving):
        linkage, (q, qd), forces = eqx.combine(moving, shared)
        tau = jnp.zeros_like(q)
        for index, element in enumerate(elements("forces", forces)):
            state = element.initial_state(linkage)
            tau = tau + element_effort(index, element, t0, q, qd, linkage, state)[0]
        # Revolute joints cause most of the steps, slides hardly any.
        turning = jnp.stack(real_joints(linkage.ef))
        rate = jnp.where(turning, qd, 0)
        qdd = forward_dynamics(linkage, q, qd, tau, forces)
        acceleration = jnp.where(turning, qdd, 0)
        topology = jnp.sum(jnp.where(turning, 2 ** jnp.arange(len(q))[::-1], 0))
        norm = jnp.linalg.norm
        return topology, norm(rate) + jnp.sqrt(norm(acceleration))

    return jax.vmap(member)(moving)


class _Chunks:
    """Solves chunks; keeps their results in memory and, if given, in a checkpoint."""

    def __init__(
        self,
        batch: Batch,
        ts: Array,
        settings: dict,
        reduce: Callable[[Solution], Any],
        checkpoint: Checkpoint | None,
    ):
        moving, self.shared = batch.split()
        self.moving = in_numpy(moving)
        self.ts, self.settings, self.reduce = ts, settings, reduce
        self.checkpoint = checkpoint
        devices = jax.devices()
        self.devices = len(devices)
        self.mesh = Mesh(np.array(devices), ("member",)) if len(devices) > 1 else None
        self.size = batch.size
        self.results: list[Any] = []
        self.structure: Any = None  # of the outcomes
        self.rows: Rows | None = None

    def solve(self, members: np.ndarray, lanes: int, limit: int) -> np.ndarray:
        """Solves members, at most `lanes` per device; returns their step counts."""
        padded = np.full(lanes * self.devices, members[0])
        padded[: len(members)] = members
        moving = jax.tree.map(lambda leaf: self._place(leaf[padded]), self.moving)
        arguments = (
            self.settings, self.mesh, self.reduce, self.ts, moving, self.shared,
            np.asarray(limit, np.int32),
        )  # fmt: skip
        values = self._kept(members, limit, arguments)
        if values is None:
            solved, self.structure = jax.tree.flatten(_solve_chunk(*arguments))
            if jax.process_count() > 1:
                solved = multihost_utils.process_allgather(solved, tiled=True)
            values = [np.asarray(leaf)[: len(members)] for leaf in solved]
            if self.checkpoint is not None and jax.process_index() == 0:
                self.checkpoint.write(members, limit, values)
        if not self.results:
            self.results = [
                np.empty((self.size, *v.shape[1:]), v.dtype) for v in values
            ]
        for kept, value in zip(self.results, values):
            kept[members] = value
        _, steps, _ = jax.tree.unflatten(self.structure, values)
        return steps

    def _kept(
        self, members: np.ndarray, limit: int, arguments: tuple
    ) -> list[np.ndarray] | None:
        """Returns the arrays of a chunk that the checkpoint holds, or None."""
        if self.checkpoint is None or not self.checkpoint.has(members, limit):
            return None
        if self.rows is None:
            like = eqx.filter_eval_shape(_solve_chunk, *arguments)
            arrays, self.structure = jax.tree.flatten(like)
            self.rows = Rows(arrays)
        return self.checkpoint.read(members, limit, self.rows)

    def _place(self, rows: np.ndarray) -> np.ndarray | Array:
        if jax.process_count() == 1:
            return rows
        assert self.mesh is not None  # several processes have several devices
        sharding = NamedSharding(self.mesh, PartitionSpec("member"))
        return jax.make_array_from_callback(rows.shape, sharding, lambda i: rows[i])


def in_chunks(
    batch: Batch,
    ts: Array,
    settings: dict,
    reduce: Callable[[Solution], Any],
    chunk: int,
    checkpoint: Checkpoint | None,
    meter: diffrax.AbstractProgressMeter,
) -> tuple[Any, np.ndarray]:
    """Returns what is kept of all members, and which of them failed."""
    topology, work = map(np.asarray, expected_work(ts[0], *batch.split()))
    waiting = np.lexsort((work, topology))  # NaN comes last
    chunks = _Chunks(batch, ts, settings, reduce, checkpoint)
    max_steps = settings["max_steps"] or np.iinfo(np.int32).max
    # Members with steps of given lengths take equally many.
    first = _FIRST_LIMIT if _adaptive(settings) else max_steps
    # Small batches are cut too, so that a slow member delays few others.
    share = -(-batch.size // (8 * chunks.devices))
    lanes, limit = min(chunk, max(share, 8 * _SMALL)), first
    done, progress = 0, meter.init()
    while len(waiting):
        late = []
        for start in range(0, len(waiting), lanes * chunks.devices):
            members = waiting[start : start + lanes * chunks.devices]
            while True:
                limit = min(limit, max_steps)
                # At max_steps diffrax's own limit lets the last step finish.
                own = limit if limit < max_steps else np.iinfo(np.int32).max
                steps = chunks.solve(members, lanes, int(own))
                out_of_steps = (steps >= limit) & (limit < max_steps)
                if out_of_steps.sum() <= len(members) // 2:
                    break
                limit *= 4  # too low for most members
            late.append(members[out_of_steps])
            done += len(members) - out_of_steps.sum()
            progress = meter.step(progress, jnp.asarray(done / batch.size))
            typical = np.percentile(steps[~out_of_steps], 90)
            limit = max(int(_SLACK * typical), first // 4)
        waiting = np.concatenate(late)
        limit = 8 * limit
        if len(waiting) <= lanes // 2:
            lanes = min(lanes, _SMALL) if len(waiting) > 1 else 1
    meter.close(progress)
    leaves = chunks.results
    for index, leaf in enumerate(leaves):
        leaves[index] = jnp.asarray(leaf)  # frees one array before the next is copied
    kept, _, failed = jax.tree.unflatten(chunks.structure, leaves)
    return kept, np.asarray(failed)


def program_of(
    reduce: Callable[[Solution], Any], batch: Batch, ts: Array, settings: dict
) -> tuple[str, list]:
    """Returns text and constants that name what `reduce` computes, in any process."""
    moving, shared = batch.split()
    first = jax.tree.map(lambda leaf: leaf[0], moving)
    like = eqx.filter_eval_shape(motion_of, settings, ts, first, shared, None)
    program, _, _ = eqx.filter_make_jaxpr(reduce)(like)
    return re.sub(" at 0x[0-9a-f]+", "", str(program)), program.consts
