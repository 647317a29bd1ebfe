"""The compiled programs of chunks: the outcomes of members, and their forecasts."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ..base.checks import refusal
from ..base.configuration import wide_vectors
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from ..steps.controllers import Abreast, by_square_roots
from ..steps.tolerances import default_controller
from .forecast import expected_work

# With so few lanes a step takes hardly longer than with one, so that slow members do
# not pay for another program.
_ALL_ALIKE = 32
_AXIS = "lane"


def motion_of(
    settings: dict, ts: Array, moving: Any, shared: Any, abreast: bool
) -> Solution:
    """Computes one member's motion; if `abreast`, until most lanes are long done."""
    linkage, state0, forces = eqx.combine(moving, shared)
    controller = settings["stepsize_controller"] or default_controller()
    # Members with steps of given lengths take equally many.
    adaptive = isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    if abreast and adaptive:
        # Other solvers, and estimates of a first step, need the error itself.
        if settings["solver"] is None and settings["dt0"] is not None:
            controller = by_square_roots(controller)
        limited = Abreast(controller, _AXIS)  # pyright: ignore[reportCallIssue]
        settings = settings | {"stepsize_controller": limited}
    return simulate(linkage, state0, ts, forces, throw=False, **settings)


def _check_kept(kept: Any) -> None:
    """Raises ValueError unless a reduction returned arrays of numbers."""
    for leaf in jax.tree.leaves(kept):
        if not eqx.is_array_like(leaf):
            raise refusal("reduce", "a function that returns arrays", leaf)
        kind = leaf.dtype if eqx.is_array(leaf) else jnp.result_type(leaf)
        if not any(jnp.issubdtype(kind, known) for known in (np.number, np.bool_)):
            raise refusal("reduce", "a function that returns numbers", kind)


def outcome_of(
    settings: dict,
    reduce: Callable[[Solution], Any],
    ts: Array,
    moving: Any,
    shared: Any,
    abreast: bool,
) -> tuple[Any, Array, Array]:
    """Computes what is kept of one member, whether it was stopped, and if it failed."""
    solution = motion_of(settings, ts, moving, shared, abreast)
    kept = reduce(solution)
    _check_kept(kept)
    results, most = diffrax.RESULTS, settings["max_steps"]
    stopped = solution.result == results.max_steps_reached
    if most is not None:
        stopped &= solution.stats["num_steps"] < most
    return kept, stopped, solution.result != results.successful


class Form(NamedTuple):
    """The key of a program: structures, constants, kinds of the arrays."""

    moving: Any  # structures of what differs between members, and of all else
    rest: Any  # `(settings, reduce, ts, shared)`, or for a forecast `(ts, shared)`
    constants: tuple[Any, ...]  # leaves of `rest`, None for arrays
    kinds: tuple[Any, Any]  # shapes and types of moving and other arrays
    series: int  # the most chunks that a call solves, one after another
    mesh: Mesh | None

    def chunks(self, rows: list[Array]) -> list[Array]:
        """Returns arrays (series * lane, ...) of one device as (series, lane, ...)."""
        # In each size, as -1 would be unknown for empty arrays.
        return [
            leaf.reshape(self.series, len(leaf) // self.series, *leaf.shape[1:])
            for leaf in rows
        ]

    def others(self, arrays: list[Array]) -> Any:
        """Returns what all members share."""
        given = iter(arrays)
        rest = [next(given) if leaf is None else leaf for leaf in self.constants]
        return jax.tree.unflatten(self.rest, rest)

    def arguments(self) -> tuple[Any, ...]:
        """Returns the shapes and types of a count, moving and other arrays."""
        like = [[_like(*kind) for kind in kinds] for kinds in self.kinds]
        return _like((), np.int32), *like

    @property
    def lanes(self) -> int:
        """The number of lanes on all devices."""
        return self.kinds[0][0][0][0] // self.series

    @property
    def rows(self) -> int:
        """The number of members in a call, on each device."""
        return self.series * self.lanes // (self.mesh.size if self.mesh else 1)

    @property
    def sharding(self) -> NamedSharding | None:
        """How arrays with an axis of lanes are spread over the devices, if several."""
        return self.mesh and NamedSharding(self.mesh, PartitionSpec("member"))


def _like(shape: tuple[int, ...], dtype: Any, weak: bool = False) -> Any:
    return jax.ShapeDtypeStruct(shape, dtype, weak_type=weak)


@functools.lru_cache(maxsize=64)
def traced(form: Form) -> jax.stages.Lowered:
    """Traces the program that computes the outcomes of the first `count` chunks.

    It returns those of the `chosen` rows of each device.
    """

    def run(count, chosen, moving, arrays):
        settings, reduce, ts, shared = form.others(arrays)
        chunks = form.chunks(moving)
        abreast = chunks[0].shape[1] > _ALL_ALIKE  # of the lanes of one device

        def member(leaves):
            member = jax.tree.unflatten(form.moving, leaves)
            return outcome_of(settings, reduce, ts, member, shared, abreast)

        @jax.jit  # traced once, though used twice
        def solved(chunk):
            return jax.vmap(member, axis_name=_AXIS)([leaf[chunk] for leaf in chunks])

        def added(chunk, outcomes):
            return jax.tree.map(
                lambda all, new: all.at[chunk].set(new), outcomes, solved(chunk)
            )

        outcomes = jax.tree.map(
            lambda leaf: jnp.zeros((form.series, *leaf.shape), leaf.dtype),
            jax.eval_shape(solved, count),
        )
        outcomes = jax.lax.fori_loop(0, count, added, outcomes)
        return jax.tree.map(
            lambda leaf: leaf.reshape(len(chosen), *leaf.shape[2:])[chosen], outcomes
        )

    if form.mesh is not None:
        lanes, same = PartitionSpec("member"), PartitionSpec()
        # Each device loops only until its own slowest member is done.
        run = jax.shard_map(
            run,
            mesh=form.mesh,
            in_specs=(same, same, lanes, same),
            out_specs=lanes,
            check_vma=False,
        )
    shardings = None, None, form.sharding, None
    count, *others = form.arguments()
    chosen = _like((form.rows,), np.int32)
    return jax.jit(run, in_shardings=shardings).lower(count, chosen, *others)


@functools.lru_cache(maxsize=64)
def compiled(form: Form) -> jax.stages.Compiled:
    """Compiles the program of this form; the programs used last are kept."""
    return traced(form).compile(wide_vectors())


@functools.lru_cache(maxsize=64)
def work_of_chunks(form: Form) -> jax.stages.Compiled:
    """Compiles the program of the `expected_work` in the first `count` chunks."""

    def run(count, moving, arrays):
        ts, shared = form.others(arrays)
        chunks = form.chunks(moving)

        def work_of(chunk):
            member = form.moving.unflatten([leaf[chunk] for leaf in chunks])
            return expected_work(ts, member, shared)

        def added(chunk, work):
            return work.at[chunk].set(work_of(chunk))

        like = jax.eval_shape(work_of, count)
        work = jnp.zeros((form.series, *like.shape), like.dtype)
        return jax.lax.fori_loop(0, count, added, work).ravel()

    return jax.jit(run).lower(*form.arguments()).compile(wide_vectors())
