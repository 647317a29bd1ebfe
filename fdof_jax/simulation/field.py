"""The vector field of a linkage with force elements, as integrators call it."""

import functools
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from ..forces.added_inertia import added_inertia, inertial
from ..forces.element import (
    Element,
    InertialElement,
    OwnStates,
    ScalarElement,
    StatefulElement,
    naming,
)
from ..forces.holders import Holder
from ..forces.switches import Switches
from ..linkage.linkage import Linkage
from ..mechanics.equations import (
    Constants,
    Scalars,
    Upper,
    link_constants,
    with_held,
    zeros,
)
from ..mechanics.rates import conditioning, rates, rates_and_conditioning
from ..steps.dopri8 import Health, Integrated, ScheduledTerm, health_if

Schedules = tuple[PyTree, ...]  # of all elements, which depend on time alone

# Below this inertia ratio the accelerations have four correct digits at best (float64)
# or two (float32).
LEAST_INERTIA_RATIO = {np.dtype("float64"): 1e-11, np.dtype("float32"): 1e-5}


class Args(NamedTuple):
    linkage: Linkage
    q0: Array
    constants: Constants
    forces: tuple[Element, ...]
    sides: Array | None = None  # (switch,) in force, where switches are located
    ahead: Array | None = None  # (element,) by which its clock is ahead, if any [s]
    modes: PyTree = None  # those of the joints, where elements hold some (see `Modes`)

    def clock(self, index: int, t: Array) -> Array:
        """Returns the time by an element's clock (see `clocks_apart`)."""
        return t if self.ahead is None else t + self.ahead[index]

    def masses(self, t: Array) -> tuple[InertialElement, ...]:
        """Returns the elements that move masses, as they are at a time."""
        rows = enumerate(self.forces)
        masses = [(k, e) for k, e in rows if isinstance(e, InertialElement)]
        return tuple(element.at(self.clock(k, t)) for k, element in masses)

    def moving(self) -> "Args":
        """Returns the arguments with the joints that are held as fixed pairs."""
        if self.modes is None:
            return self
        held = tuple(self.modes.held)
        return self._replace(constants=with_held(self.constants, held))


def args_of(linkage: Linkage, q0: Array, forces: tuple[Element, ...]) -> Args:
    # XLA's own sine and cosine, once per solve, as start angles may be large.
    constants = link_constants(linkage, q0, lambda x: (jnp.sin(x), jnp.cos(x)))
    return Args(linkage, q0, constants, forces)


def schedule_of(t: Array, args: Args) -> Schedules:
    """Returns each element's schedule."""
    schedules = []
    for index, element in enumerate(args.forces):
        with naming(f"forces[{index}]"):
            at = args.clock(index, t)
            schedules.append(element.schedule(at, args.linkage))
    return tuple(schedules)


def has_states(linkage: Linkage, forces: tuple[Element, ...]) -> bool:
    """Returns whether there is a number in any element's state; some drives have none.

    A `SpeedLimit`, for instance, has no state but that of its command.
    """
    states = jax.eval_shape(lambda: initial_states(linkage, forces))
    return bool(jax.tree.leaves(states))


def with_states(
    forces: tuple[Element, ...], own: OwnStates
) -> Iterator[tuple[int, Element, PyTree]]:
    """Yields each element with its index and its state, () without one."""
    states = iter(own)
    for index, element in enumerate(forces):
        state = next(states) if isinstance(element, StatefulElement) else ()
        yield index, element, state


def initial_states(linkage: Linkage, forces: tuple[Element, ...]) -> OwnStates:
    """Returns the first states of elements with a state of their own, maybe empty."""
    stateful = (e for e in forces if isinstance(e, StatefulElement))
    return tuple(element.initial_state(linkage) for element in stateful)


def initial_own(args: Args, own0: OwnStates | None = None) -> Scalars:
    """Returns the elements' initial states as scalars: `own0`, or their defaults."""
    own = initial_states(args.linkage, args.forces) if own0 is None else own0
    return _scalars(own, args.q0.dtype)


def whole(delta: Scalars, qd: Scalars, own: Scalars) -> Integrated:
    """Returns an integrated state, or its rates; diffrax takes no empty tuple in it."""
    return (delta, qd, own) if own else (delta, qd)


def own_states(args: Args, y: Integrated) -> OwnStates:
    """Rebuilds the states of the stateful elements from the integrated scalars."""
    left = iter(y[2] if len(y) > 2 else ())
    return jax.tree.map(
        lambda leaf: jnp.array([*islice(left, leaf.size)]).reshape(leaf.shape),
        jax.eval_shape(lambda: initial_states(args.linkage, args.forces)),
    )


def _scalars(tree: PyTree, dtype: np.dtype) -> Scalars:
    leaves = [jnp.asarray(leaf, dtype).ravel() for leaf in jax.tree.leaves(tree)]
    return tuple(jnp.concatenate(leaves)) if leaves else ()


def efforts(
    t: Array, y: Integrated, args: Args, schedule: Schedules
) -> tuple[Scalars, Scalars, Switches]:
    """Returns efforts of the elements, rates of their states, and their switches.

    Builds arrays only where an element needs them.
    """
    delta, qd, *_ = y
    tau, own_rates = None, []
    switches = Switches(args.sides)
    arrays = lambda: (args.q0 + jnp.stack(delta), jnp.stack(qd))
    elements = with_states(args.forces, own_states(args, y))
    for (index, element, state), scheduled in zip(elements, schedule):
        if isinstance(element, Holder) and element.holds:
            sliding = qd if args.modes is None else tuple(args.modes.direction)
            effort = element.respond(scheduled, delta, sliding, args.linkage)
        elif isinstance(element, ScalarElement):
            q = tuple(a + b for a, b in zip(args.q0, delta))
            with switches.dealt():
                effort = element.respond(scheduled, q, qd, args.linkage)
        else:
            at = args.clock(index, t), *arrays(), args.linkage
            effort, rate, values, jumping = effort_and_switches(
                index, element, *at, state, switches.rest()
            )
            switches.add(values, jumping)
            own_rates += _scalars(rate, args.q0.dtype)
        tau = effort if tau is None else tuple(a + b for a, b in zip(tau, effort))
    tau = zeros(args.q0) if tau is None else tuple(tau)
    return tau, tuple(own_rates), switches


def switching(
    t: Array, y: Integrated, args: Args, schedule: Schedules
) -> tuple[Array, tuple[bool, ...]]:
    """Returns the switching functions of all efforts, and which of them jump."""
    *_, switches = efforts(t, y, args, schedule)
    return switches.all_values(args.q0.dtype), tuple(switches.jumping)


def applied(
    t: Array, y: Integrated, args: Args, schedule: Schedules
) -> tuple[Scalars, Scalars, Upper | None, Switches]:
    """Returns efforts, rates of states, inertia that elements add, and switches."""
    tau, own_rates, switches = efforts(t, y, args, schedule)
    delta, qd, *_ = y
    if not inertial(args.forces):
        return tau, own_rates, None, switches
    q, qd = args.q0 + jnp.stack(delta), jnp.stack(qd)
    added, bias = _added(args.linkage, args.masses(t), q, qd)
    tau = tuple(a - b for a, b in zip(tau, bias))
    return tau, own_rates, added, switches


_added: Any = eqx.filter_jit(added_inertia)  # traced once, not at each use by a solver


def health_at(losses: Scalars) -> Health:
    """Returns the health at losses of accuracy: these, or 0 if too much is lost."""
    least = LEAST_INERTIA_RATIO[losses[0].dtype]
    # Exactly, no loss is below 1; that of a fixed pair is stored as 0.
    return tuple(
        jnp.where(loss * least > 1, 0, jnp.where(loss < 1, 1, loss)) for loss in losses
    )


def health_with(rates: PyTree, health: Health) -> Health:
    return health_if(jnp.isfinite(sum(jax.tree.leaves(rates))), health)


def vector_field(t, y, args, schedule) -> Integrated:
    """Rates of joint displacements, of velocities and of the elements' own states."""
    delta, qd, *_ = y
    tau, own_rates, added, _ = applied(t, y, args, schedule)
    constants = args.moving().constants
    return whole(*rates(constants, delta, qd, tau, added), own_rates)


def watched_field(t, y, args, schedule) -> tuple[Integrated, Health]:
    """Rates of `vector_field` and their health, which `ScheduledTerm` defines."""
    delta, qd, *_ = y
    tau, own_rates, added, _ = applied(t, y, args, schedule)
    constants = args.moving().constants
    (qd, qdd), losses = rates_and_conditioning(constants, delta, qd, tau, added)
    health = health_with((qdd, own_rates), health_at(losses))
    return whole(qd, qdd, own_rates), health


def health_of(t, y, args) -> Health:
    """Health of the equations at each joint: positive, or 0 where they are singular."""
    delta, *_ = y
    added = None
    if inertial(args.forces):
        q = args.q0 + jnp.stack(delta)
        still = jnp.zeros_like(q)
        added, _ = _added(args.linkage, args.masses(t), q, still)
    return health_at(conditioning(args.moving().constants, delta, added))


def total_effort(
    linkage: Linkage, forces: tuple[Element, ...], t: Array, q: Array, qd: Array
) -> Array:
    """Computes the sum of elements' efforts in their initial states [N or N m]."""
    total = jnp.zeros_like(q)
    for k, element in enumerate(forces):
        state = element.initial_state(linkage)
        total = total + element_effort(k, element, t, q, qd, linkage, state)
    return total


def element_effort(
    index: int,
    element: Element,
    t: Array,
    q: Array,
    qd: Array,
    linkage: Linkage,
    state: PyTree,
) -> Array:
    """Returns an element's effort.

    Raises ValueError unless it is a real number for each joint.
    """
    return effort_and_switches(index, element, t, q, qd, linkage, state)[0]


@eqx.filter_jit  # traced once, not at each use by a solver
def effort_and_switches(
    index: int,
    element: Element,
    t: Array,
    q: Array,
    qd: Array,
    linkage: Linkage,
    state: PyTree,
    sides: Array | None = None,
) -> tuple[Array, PyTree, list[Array], list[bool]]:
    """Returns an element's effort, the rate of its state, and the switches it met."""
    switches = Switches(sides)
    expected = (
        f"forces[{index}]: expected it to return tau, an array of {len(q)} real numbers"
    )
    with naming(f"forces[{index}]"), switches.dealt():
        answer: Any = element.act(t, q, qd, linkage, state)
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise ValueError(
            f"{expected}, and the rate of its state, got {_shown(answer)}."
        )
    tau, rate = answer
    if jax.tree.map(jnp.shape, rate) != jax.tree.map(jnp.shape, state):
        raise ValueError(
            f"forces[{index}]: expected the rate of its state to be like the state, "
            f"{_shown(state)}, got {_shown(rate)}."
        )
    try:
        tau = jnp.asarray(tau)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{expected}, got {_shown(tau)}.") from error
    if tau.shape != q.shape or tau.dtype.kind not in "iuf":
        raise ValueError(f"{expected}, got shape {tau.shape} and dtype {tau.dtype}.")
    return tau.astype(q.dtype), rate, switches.values, switches.jumping


def _shown(tree: PyTree) -> str:
    return eqx.tree_pformat(tree)  # arrays by dtype and shape, traced ones too


class _Packed(eqx.Module):
    """A tree of scalars as one array of numbers and one of flags."""

    numbers: Array
    flags: Array
    structure: Any = eqx.field(static=True)
    is_flag: tuple[bool, ...] = eqx.field(static=True)

    def scalars(self) -> Constants:
        numbers, flags = iter(self.numbers), iter(self.flags)
        leaves = [next(flags if flag else numbers) for flag in self.is_flag]
        return jax.tree.unflatten(self.structure, leaves)


def _packed(scalars: Constants) -> _Packed:
    leaves, structure = jax.tree.flatten(jax.tree.map(jnp.asarray, scalars))
    is_flag = tuple(leaf.dtype == bool for leaf in leaves)
    numbers, flags = (
        # Of known joints there are no flags.
        jnp.array([leaf for leaf, flag in zip(leaves, is_flag) if flag == kind], dtype)
        for kind, dtype in ((False, None), (True, bool))
    )
    return _Packed(numbers, flags, structure, is_flag)


def in_arrays(
    term: ScheduledTerm, y: Integrated, args: Args
) -> tuple[ScheduledTerm, Integrated, Args]:
    """Returns term, state and arguments in arrays instead of tuples of scalars.

    XLA compiles a kernel for each array that changes in a loop or is computed for it,
    in much the same time for one number as for many. Plain calls use arrays; batches
    are faster with scalars.
    """
    packed = args._replace(constants=_packed(args.constants))  # pyright: ignore[reportArgumentType]
    return _of_arrays(term), tuple(map(jnp.stack, y)), packed


@functools.cache  # for the same term, so that its functions are traced once
def _of_arrays(term: ScheduledTerm) -> ScheduledTerm:
    def of_scalars(function: Callable) -> Callable:
        def unpacked(t, y, args, *schedule):
            args = args._replace(constants=args.constants.scalars())
            return function(t, tuple(map(tuple, y)), args, *schedule)

        return unpacked

    def first_in_arrays(function: Callable) -> Callable:
        function = of_scalars(function)

        def stacked(*at):
            y, other = function(*at)
            return tuple(map(jnp.stack, y)), other

        return stacked

    field = of_scalars(term.vector_field)
    return ScheduledTerm(
        lambda *at: tuple(map(jnp.stack, field(*at))),
        term.schedule,
        of_scalars(term.health),
        first_in_arrays(term.watched_field),
        of_scalars(term.switching),
        term.unknown_modes,
        term.resolve and first_in_arrays(term.resolve),  # of an event, not a time
    )
