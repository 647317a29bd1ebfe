"""Solves a batch in chunks of members that take about equally long."""

import functools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    Future,
    ThreadPoolExecutor,
    as_completed,
    wait,
)
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import SingleDeviceSharding
from jaxtyping import PyTree

from ..base.checks import refusal
from ..base.known_values import in_numpy, known_array
from ..dynamics import energy, forward_dynamics
from ..forces.added_inertia import present
from ..forces.element import elements
from ..forces.holders import holders
from ..linkage.topology import real_joints
from ..simulation.integrate import Inputs, Settings
from ..simulation.scene import Scene
from ..simulation.simulate import elements_at_door
from ..simulation.solution import Solution
from ..simulation.solve import solve as solve_motion
from ..simulation.vector_field import total_effort
from ..steps.tolerances import by_square_roots, default_controller
from .devices import (
    Device,
    compiled,
    copied,
    in_place,
    in_thread,
    of_cores,
    solve,
    thread_of,
)

# With at most so many lanes a step takes hardly longer than with one, so that it would
# not pay to stop slow members and solve them in another program.
_ALL_ALIKE = 32
_AXIS = "lane"
_SMALL = 8  # lanes of the chunks for a few slow members
_COPIED_AT_ONCE = 2**24  # bytes to a device
_FORECASTS = 1024  # computed at once
_STEPS, _ANGLE = 16, 0.3  # of the rough motion in a forecast: number and size


class Common(NamedTuple):
    shared: PyTree  # of a `Batch`
    ts: Array | np.ndarray
    settings: Settings
    reduce: Callable[[Scene, Solution], PyTree]


class Job(NamedTuple):
    moving: PyTree  # of a `Batch`
    common: Common
    size: int
    chunk: int
    devices: list[Device]


class Outcome(NamedTuple):
    value: PyTree  # what the reduction returns
    stopped: Array  # because most lanes were long done
    failed: Array


def _check_value(value: PyTree) -> None:
    """Raises ValueError unless a reduction returned arrays of numbers."""
    for leaf in jax.tree.leaves(value) or [value]:
        if not eqx.is_array_like(leaf):
            raise refusal("reduce", "a function that returns arrays", leaf)
        dtype = leaf.dtype if eqx.is_array(leaf) else jnp.result_type(leaf)
        if not any(jnp.issubdtype(dtype, kind) for kind in (np.number, np.bool_)):
            raise refusal("reduce", "a function that returns numbers", dtype)


def outcome_of(common: Common, moving: PyTree, abreast: bool = False) -> Outcome:
    """Computes the outcome of one member.

    If `abreast`, it stops when most lanes are long done.
    """
    linkage, state0, forces = eqx.combine(moving, common.shared)
    settings = common.settings
    settings = settings | {"progress_meter": diffrax.NoProgressMeter()}
    controller = settings["stepsize_controller"] or default_controller()
    # With fixed steps all members take equally many.
    if abreast and isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        # Other solvers, and estimates of a first step, need the error itself.
        if settings["solver"] is None and settings["dt0"] is not None:
            controller = by_square_roots(controller)
        settings |= {"lanes": _AXIS, "stepsize_controller": controller}
    acting = elements_at_door(linkage, forces)
    inputs = Inputs(linkage, state0, jnp.asarray(common.ts), None, acting)
    solution, _ = solve_motion(inputs, settings)
    scene = Scene(linkage, state0, forces, common.ts[-1])
    value = common.reduce(scene, solution)
    _check_value(value)
    results, most = diffrax.RESULTS, settings["max_steps"]
    stopped = solution.result == results.max_steps_reached
    if most is not None:
        stopped &= solution.stats["num_steps"] < most
    return Outcome(value, stopped, solution.result != results.successful)


# Programs of chunks


class Form(NamedTuple):
    """The key of a program: its function, structures, kinds of arrays, constants."""

    function: Callable[..., PyTree]  # of a `Common` and the members
    moving: Any  # structure of what differs between members
    lanes: tuple[jax.ShapeDtypeStruct, ...]  # its arrays
    common: Any  # structure
    leaves: tuple[Any, ...]  # of `common`: kinds of arrays, and constants

    def values(self, lanes: list[Array], arrays: list[Array]) -> PyTree:
        given = iter(arrays)
        value = lambda x: known_array(x) if isinstance(x, tuple) else x
        leaves = [next(given) if _is_kind(x) else value(x) for x in self.leaves]
        return self.function(
            self.common.unflatten(leaves), self.moving.unflatten(lanes)
        )


@functools.lru_cache
def _kind(shape: tuple[int, ...], dtype: Any, weak: bool) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype, weak_type=weak)


def _is_kind(leaf: object) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


def _form_of(
    function: Callable, job: Job, lanes: int
) -> tuple[Form, list[Array], list[Array]]:
    """Returns the form of the program for so many lanes, and its arrays."""

    def kind(array: Array, shape: tuple[int, ...]) -> jax.ShapeDtypeStruct:
        dtype = jax.dtypes.canonicalize_dtype(array.dtype, allow_extended_dtype=True)
        return _kind(shape, dtype, getattr(array, "weak_type", False))

    def cast(arrays: list[Array], kinds: Sequence[jax.ShapeDtypeStruct]) -> list[Array]:
        """Casts arrays to the program's types, which its call does not."""
        pairs = zip(in_numpy(arrays), kinds)
        return [a if a.dtype == k.dtype else a.astype(k.dtype) for a, k in pairs]

    members, structure = jax.tree.flatten(job.moving)
    kinds = tuple(kind(a, (lanes, *a.shape[1:])) for a in members)
    leaves: list[Any]
    leaves, others = jax.tree.flatten(job.common)
    # Existence factors that all members share are part of the program, which leaves out
    # the equations of other joints: 256 arms of Fig 7 take half the time, and compile
    # in three quarters (AMD EPYC, jax 0.12).
    ef = job.common.shared[0].ef
    leaves = [tuple(x.tolist()) if x is ef else x for x in leaves]
    common = tuple(kind(x, x.shape) if eqx.is_array(x) else x for x in leaves)
    arrays = [leaf for leaf, own in zip(leaves, common) if _is_kind(own)]
    return (
        Form(function, structure, kinds, others, common),
        cast(members, kinds),
        cast(arrays, [*filter(_is_kind, common)]),
    )


@functools.lru_cache(maxsize=64)
def _jitted(form: Form) -> jax.stages.Wrapped:
    return jax.jit(form.values)  # traced once for all devices


@functools.lru_cache(maxsize=64)
def _lowered(form: Form, device: Device) -> jax.stages.Lowered:
    """Traces the program of this form for a device."""
    arguments = list(form.lanes), list(filter(_is_kind, form.leaves))
    if device is not None:
        there = SingleDeviceSharding(device)
        arguments = jax.tree.map(lambda kind: kind.update(sharding=there), arguments)
    return _jitted(form).lower(*arguments)


def _programs(form: Form, devices: list[Device]) -> list[jax.stages.Compiled]:
    if len(devices) > 1 and devices[0].client is devices[1].client:
        # Tracing depends on settings of this thread.
        programs = [_lowered(form, device) for device in devices]
        with ThreadPoolExecutor(len(devices)) as pool:
            return list(pool.map(compiled, programs))
    first, *others = devices
    program = compiled(_lowered(form, first))
    copy = lambda core: copied(program, core) or compiled(_lowered(form, core))
    return [program, *map(copy, others)]


def _in_lanes(
    function: Callable, job: Job, devices: list[Device], members: np.ndarray, lanes: int
) -> Iterator[tuple[np.ndarray, PyTree]]:
    """Yields chunks of members, as they are done, and their values."""
    chunks = [members[i : i + lanes] for i in range(0, len(members), lanes)]
    devices = devices[: len(chunks)]
    form, leaves, arrays = _form_of(function, job, lanes)

    def rows_of(members: np.ndarray) -> list[Array]:
        rows = members[np.minimum(np.arange(lanes), len(members) - 1)]
        return [leaf[rows] for leaf in leaves]

    programs = _programs(form, devices)
    if devices == [None]:
        for chunk in chunks:
            yield chunk, solve(programs[0], rows_of(chunk), arrays)
        return
    running: dict[Future, tuple[int, np.ndarray]] = {}
    # Each device has up to two chunks: one that it solves, and the next.
    free = deque(2 * list(range(len(devices))))
    for chunk in chunks:
        if not free:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                number, solved = running.pop(future)
                free.append(number)
                yield solved, future.result()
        number = free.popleft()
        arguments = in_place((rows_of(chunk), arrays), devices[number])
        thread, program = thread_of(devices[number]), programs[number]
        future = thread.submit(in_thread, solve, program, *arguments)
        running[future] = number, chunk
    for future in as_completed(running):
        yield running[future][1], future.result()


# Forecasts


def expected_work(common: Common, moving: PyTree) -> Array:
    """Computes for each member a number that grows with its steps.

    It averages the joints' rates and accelerations over a rough beginning of the motion
    [1/s]. Where elements hold joints it is the energy [J], of which each event takes
    some.
    """
    ts = common.ts

    def member(moving):
        linkage, (q, qd), forces = eqx.combine(moving, common.shared)
        acting = elements("forces", forces)
        if holders(acting):
            kinetic, potential = energy(linkage, q, qd, present(acting, ts[0]))
            return kinetic + potential
        # Revolute joints cause most of the steps, slides hardly any.
        turning = jnp.stack(real_joints(linkage.ef))

        def at(t, q, qd):
            tau = total_effort(linkage, acting, t, q, qd)
            qdd = forward_dynamics(linkage, q, qd, tau, present(acting, t))
            rate, acceleration = (jnp.where(turning, a, 0) for a in (qd, qdd))
            norm = jnp.linalg.norm
            return qdd, norm(rate) + jnp.sqrt(norm(acceleration))

        def advance(_, now):
            t, q, qd, total, last = now
            qdd, rate = at(t, q, qd)
            # If the rough steps diverge, the state stays at its last finite value.
            finite = jnp.isfinite(rate)
            h = jnp.where(finite, step, 0)
            last = jnp.where(finite, rate, last)
            qd = qd + h * jnp.where(finite, qdd, 0)
            return t + h, q + h * qd, qd, total + last, last

        _, first = at(ts[0], q, qd)
        step = jnp.minimum((ts[-1] - ts[0]) / _STEPS, _ANGLE / first)
        start = ts[0], q, qd, jnp.zeros_like(first), first
        *_, total, _ = jax.lax.fori_loop(0, _STEPS, advance, start)
        return total

    return jax.vmap(member)(moving)


def _forecast(job: Job, devices: list[Device]) -> np.ndarray:
    """Returns the `expected_work` of all members, by one program for any number."""
    common = job.common._replace(settings={}, reduce=None)  # which make no difference
    works = np.empty(job.size)
    everyone, job = np.arange(job.size), job._replace(common=common)
    for members, found in _in_lanes(expected_work, job, devices, everyone, _FORECASTS):
        works[members] = np.asarray(found)[: len(members)]
    return works


# Chunks


def _lanes(members: int, chunk: int) -> int:
    """Returns the number of lanes for some members, one of few for all batches."""
    if members == 1:
        return 1
    return min(chunk, max(_SMALL, 1 << (members - 1).bit_length()))


def _outcomes(common: Common, moving: PyTree) -> Outcome:
    abreast = jax.tree.leaves(moving)[0].shape[0] > _ALL_ALIKE
    member = lambda moving: outcome_of(common, moving, abreast)
    return jax.vmap(member, axis_name=_AXIS)(moving)


def in_chunks(
    job: Job, meter: diffrax.AbstractProgressMeter | None = None, on_device: bool = True
) -> Outcome:
    """Returns the outcomes of all members, in NumPy's arrays unless `on_device`."""
    size, devices = job.size, job.devices
    lanes = _lanes(-(-size // len(devices)), job.chunk)
    if size > _ALL_ALIKE:  # XLA splits no operation of fewer lanes among cores
        devices = of_cores(devices)
    order = np.arange(size)
    if size > lanes:
        # The longest come first, so that no core waits long for another at the end.
        order = np.argsort(_forecast(job, devices))[::-1]
    # The row of each member in the results. In the order of the forecasts they are
    # written faster; their own order, restored at the end, takes more memory.
    place = np.argsort(order) if on_device else np.arange(size)
    done, results, structure, remaining = 0, [], None, order
    progress = meter.init() if meter is not None else None
    while len(remaining):
        postponed = []
        for members, outcome in _in_lanes(_outcomes, job, devices, remaining, lanes):
            postponed.append(members[np.asarray(outcome.stopped)[: len(members)]])
            done += len(members) - len(postponed[-1])
            if meter is not None:
                progress = meter.step(progress, np.asarray(done / size))
            values, structure = jax.tree.flatten(outcome)
            if not results:
                if done == size == lanes:  # a single chunk, in order
                    if meter is not None:
                        meter.close(progress)
                    if devices == [None]:
                        return outcome
                    whole = jax.tree.map(np.asarray, outcome)
                    return jax.device_put(whole) if on_device else whole
                results = [np.empty((size, *v.shape[1:]), v.dtype) for v in values]
            rows = place[members]
            if (np.diff(rows) == 1).all():  # a slice is faster
                rows = slice(rows[0], rows[-1] + 1)
            for result, value in zip(results, values):
                result[rows] = np.asarray(value)[: len(members)]
        remaining = np.concatenate(postponed)
        if 0 < len(remaining) <= lanes // _SMALL:
            lanes = _lanes(min(len(remaining), _SMALL), job.chunk)
    if meter is not None:
        meter.close(progress)
    if on_device:
        for index, leaf in enumerate(results):
            results[index] = leaf[place]
            if leaf.nbytes > _COPIED_AT_ONCE:  # frees one before the next is copied
                results[index] = jax.device_put(results[index])
        results = jax.device_put(results)
    return jax.tree.unflatten(structure, results)
