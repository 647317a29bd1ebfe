"""The programs of chunks: the outcomes of members, and the work expected of them."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import SingleDeviceSharding

from ..base.checks import refusal
from ..base.configuration import wide_vectors
from ..dynamics import forward_dynamics
from ..forces.element import elements
from ..linkage.topology import real_joints
from ..simulation.field import element_effort
from ..simulation.simulate import simulate
from ..simulation.solution import Solution
from ..steps.controllers import Abreast, by_square_roots
from ..steps.tolerances import default_controller

# With so few lanes a step takes hardly longer than with one, so that slow members do
# not pay for another program.
_ALL_ALIKE = 32
_AXIS = "lane"
_STEPS, _ANGLE = 16, 0.3  # of the rough motion in a forecast: number and size


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
    """Computes what is kept of one member, whether it was stopped, and if it failed.

    If `abreast`, a member is stopped when most lanes are long done.
    """
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
    solution = simulate(linkage, state0, ts, forces, throw=False, **settings)
    kept = reduce(solution)
    _check_kept(kept)
    results, most = diffrax.RESULTS, settings["max_steps"]
    stopped = solution.result == results.max_steps_reached
    if most is not None:
        stopped &= solution.stats["num_steps"] < most
    return kept, stopped, solution.result != results.successful


class Form(NamedTuple):
    """The key of a program: structures, kinds of the arrays, constants."""

    moving: Any  # structure of what differs between members
    lanes: tuple[jax.ShapeDtypeStruct, ...]  # its arrays
    rest: Any  # structure of `(settings, reduce, ts, shared)`
    leaves: tuple[Any, ...]  # of `rest`: kinds of arrays, and constants

    def outcomes(self, lanes: list[Array], arrays: list[Array]) -> Any:
        """Computes the outcomes of all lanes of a chunk."""
        given = iter(arrays)
        leaves = [next(given) if _is_kind(leaf) else leaf for leaf in self.leaves]
        settings, reduce, ts, shared = self.rest.unflatten(leaves)

        def member(leaves):
            moving = self.moving.unflatten(leaves)
            abreast = self.lanes[0].shape[0] > _ALL_ALIKE
            return outcome_of(settings, reduce, ts, moving, shared, abreast)

        return jax.vmap(member, axis_name=_AXIS)(lanes)


def form_of(moving: Any, lanes: int, rest: Any) -> tuple[Form, list[Any]]:
    """Returns the form of the program for so many members, and the arrays of `rest`."""

    def kind(array: Any, shape: tuple[int, ...]) -> jax.ShapeDtypeStruct:
        dtype = jax.dtypes.canonicalize_dtype(array.dtype, allow_extended_dtype=True)
        weak = getattr(array, "weak_type", False)
        return jax.ShapeDtypeStruct(shape, dtype, weak_type=weak)

    members, structure = jax.tree.flatten(moving)
    kinds = tuple(kind(a, (lanes, *a.shape[1:])) for a in members)
    leaves, others = jax.tree.flatten(rest)
    arrays = [leaf for leaf in leaves if isinstance(leaf, Array | np.ndarray)]
    for index, leaf in enumerate(leaves):
        if isinstance(leaf, Array | np.ndarray):
            leaves[index] = kind(leaf, leaf.shape)
    return Form(structure, kinds, others, tuple(leaves)), arrays


def _is_kind(leaf: Any) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


@functools.lru_cache(maxsize=64)
def _jitted(form: Form) -> Any:
    return jax.jit(form.outcomes)  # traced once for all devices


@functools.lru_cache(maxsize=64)
def lowered(form: Form, device: Any) -> jax.stages.Lowered:
    """Traces the program of this form for a device, or for the default one (None).

    It computes outcomes from the arrays of the lanes and of the rest.
    """
    arguments = list(form.lanes), list(filter(_is_kind, form.leaves))
    if device is not None:
        there = SingleDeviceSharding(device)
        arguments = jax.tree.map(lambda kind: kind.update(sharding=there), arguments)
    return _jitted(form).lower(*arguments)


@functools.lru_cache(maxsize=64)
def compiled(program: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compiles a program; those used last are kept."""
    return program.compile(wide_vectors())


@eqx.filter_jit
def expected_work(ts: Array, moving: Any, shared: Any) -> Array:
    """Computes for each member a rate [1/s] that grows with its steps.

    It combines the joints' rates and accelerations, in the mean over the beginning of
    the motion, which rough steps find.
    """

    def member(moving):
        linkage, (q, qd), forces = eqx.combine(moving, shared)
        # Revolute joints cause most of the steps, slides hardly any.
        turning = jnp.stack(real_joints(linkage.ef))

        def at(t, q, qd):
            tau = jnp.zeros_like(q)
            for index, element in enumerate(elements("forces", forces)):
                state = element.initial_state(linkage)
                tau = tau + element_effort(index, element, t, q, qd, linkage, state)[0]
            qdd = forward_dynamics(linkage, q, qd, tau, forces)
            rate, acceleration = (jnp.where(turning, a, 0) for a in (qd, qdd))
            norm = jnp.linalg.norm
            return qdd, norm(rate) + jnp.sqrt(norm(acceleration))

        def advance(_, now):
            t, q, qd, total, last = now
            qdd, rate = at(t, q, qd)
            # A motion that these steps lose stays where it was.
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
