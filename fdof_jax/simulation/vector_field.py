"""The vector field of a linkage with force elements."""

import functools
import operator
from collections.abc import Iterator
from itertools import islice
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from ..base.checks import place_of
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
    equations,
    link_constants,
    with_held,
    zeros,
)
from ..mechanics.rates import conditioning, rates, rates_and_conditioning
from ..mechanics.solve import divided, minus, solver_of, times, with_added
from ..steps.term import Health, Integrated, health_if
from .prescribed import prescribed
from .sampler import Sampler, unsampled
from .until import CONDITIONS, Until

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
    lead: Array | None = None  # (element,) by which its clock leads, if any [s]
    modes: PyTree = None  # those of the joints, where elements hold some (see `Modes`)
    sampled: PyTree = None  # what a controller has sampled, if any (see `SampleState`)

    def clock(self, index: int, t: Array) -> Array:
        """Returns the time by an element's clock (see `clocks_apart`)."""
        return t if self.lead is None else t + self.lead[index]

    def masses(self, t: Array) -> tuple[InertialElement, ...]:
        """Returns the elements that move masses, as at time `t`."""
        rows = enumerate(self.forces)
        masses = [(k, e) for k, e in rows if isinstance(e, InertialElement)]
        return tuple(element.at(self.clock(k, t)) for k, element in masses)

    @property
    def moved(self) -> Array | None:
        """Flags (n,) of prescribed joints; None without any."""
        motion = prescribed(self.forces)
        return None if motion is None else motion.prescribes(self.linkage)

    def moving(self, held: Array | None = None) -> Constants:
        """Returns the constants with prescribed and held joints as fixed pairs."""
        constants, moved = self.constants, self.moved
        if held is None and self.modes is not None:
            held = self.modes.held
        still = [flags for flags in (held, moved) if flags is not None]
        if not still:
            return constants
        return with_held(constants, tuple(functools.reduce(jnp.logical_or, still)))


def args_of(linkage: Linkage, q0: Array, forces: tuple[Element, ...]) -> Args:
    # XLA's own sine and cosine, once per solve, as start angles may be large.
    constants = link_constants(linkage, q0, lambda x: (jnp.sin(x), jnp.cos(x)))
    return Args(linkage, q0, constants, forces, sampled=unsampled(forces, linkage))


def schedule_of(t: Array, args: Args) -> Schedules:
    schedules = []
    for index, element in enumerate(args.forces):
        with naming(f"forces[{index}]"):
            at = args.clock(index, t)
            schedules.append(element.schedule(at, args.linkage))
    return tuple(schedules)


def has_states(linkage: Linkage, forces: tuple[Element, ...]) -> bool:
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
    stateful = (e for e in forces if isinstance(e, StatefulElement))
    return tuple(element.initial_state(linkage) for element in stateful)


def initial_own(args: Args, own0: OwnStates | None = None) -> Scalars:
    """Returns `own0`, or the elements' initial states, as scalars."""
    own = initial_states(args.linkage, args.forces) if own0 is None else own0
    return _scalars(own, args.q0.dtype)


def whole(delta: Scalars, qd: Scalars, own: Scalars) -> Integrated:
    """Returns an integrated state, or its rates, without an empty tuple."""
    return (delta, qd, own) if own else (delta, qd)


def own_states(args: Args, y: Integrated) -> OwnStates:
    left = iter(y[2] if len(y) > 2 else ())
    return jax.tree.map(
        lambda leaf: jnp.array([*islice(left, leaf.size)]).reshape(leaf.shape),
        jax.eval_shape(lambda: initial_states(args.linkage, args.forces)),
    )


def _scalars(tree: PyTree, dtype: np.dtype) -> Scalars:
    leaves = [jnp.asarray(leaf, dtype).ravel() for leaf in jax.tree.leaves(tree)]
    return tuple(jnp.concatenate(leaves)) if leaves else ()


def followed(
    y: Integrated, args: Args, schedule: Schedules
) -> tuple[Integrated, Scalars | None]:
    """Returns a state with prescribed joints where they are, and accelerations.

    These are 0 at other joints, and None without prescribed ones.
    """
    if (motion := prescribed(args.forces)) is None:
        return y, None
    q, qd, qdd = schedule[place_of(motion, args.forces)]
    moved, (delta, rates, *own) = motion.prescribes(args.linkage), y
    there = jnp.where(moved, q - args.q0, jnp.stack(delta))
    rates = jnp.where(moved, qd, jnp.stack(rates))
    return (tuple(there), tuple(rates), *own), tuple(jnp.where(moved, qdd, 0))


def with_prescribed_rates(t: Array, y: Integrated, args: Args) -> Integrated:
    """Returns a state after the impact of a jump of prescribed velocities.

    M_FF dqd_F = -M_FH dqd_H; held joints stay held.
    """
    there, _ = followed(y, args, schedule_of(t, args))
    delta, qd, *own = there
    change = jnp.stack(qd) - jnp.stack(y[1])
    added, _ = _added_at(t, delta, qd, args)
    m = with_added(added, equations(args.constants, delta, qd))
    solve, _ = solver_of(args.moving(), m, added, divided)
    others = solve(tuple(-x for x in times(m.mass, tuple(change))))
    return (delta, tuple(a + b for a, b in zip(qd, others)), *own)


def efforts(
    t: Array, y: Integrated, args: Args, schedule: Schedules
) -> tuple[Scalars, Scalars, Switches]:
    """Returns efforts of the elements, rates of their states, and their switches."""
    delta, qd, *_ = y
    tau, own_rates = None, []
    switches = Switches(args.sides)
    arrays = lambda: (args.q0 + jnp.stack(delta), jnp.stack(qd))
    elements = with_states(args.forces, own_states(args, y))
    for (index, element, state), scheduled in zip(elements, schedule):
        if isinstance(element, Holder) and element.holds:
            sliding = qd if args.modes is None else tuple(args.modes.direction)
            q = tuple(a + b for a, b in zip(args.q0, delta))
            with naming(f"forces[{index}]"):
                effort = element.against(sliding, scheduled, q, qd, args.linkage)
        elif isinstance(element, Sampler):
            effort = tuple(args.sampled.acting)
        elif isinstance(element, ScalarElement):
            q = tuple(a + b for a, b in zip(args.q0, delta))
            with switches.dealt():
                effort = element.respond(scheduled, q, qd, args.linkage)
        else:
            at = args.clock(index, t), *arrays(), args.linkage
            effort, rate, values, jumping = effort_and_switches(
                index, element, *at, state, switches.rest()
            )
            known = isinstance(element, CONDITIONS)  # whose own function is its last
            switches.add(values, [*jumping[:-1], None] if known else jumping)
            own_rates += _scalars(rate, args.q0.dtype)
        tau = effort if tau is None else tuple(a + b for a, b in zip(tau, effort))
    tau = zeros(args.q0) if tau is None else tuple(tau)
    return tau, tuple(own_rates), switches


def switching(
    t: Array, y: Integrated, args: Args, schedule: Schedules
) -> tuple[Array, tuple[bool, ...]]:
    """Returns all switching functions, and which of them jump."""
    y, _ = followed(y, args, schedule)
    *_, switches = efforts(t, y, args, schedule)
    return switches.all_values(args.q0.dtype), tuple(switches.jumping)


class Forcing(NamedTuple):
    """Causes of motion at a state.

    - `delta`, `qd`: displacements and velocities, prescribed ones as they are.
    - `tau`: efforts, less what prescribed joints and added masses take.
    - `own_rates`: of the elements' states; `added`: inertia of their masses.
    - `given`: prescribed accelerations, or None.
    """

    delta: Scalars
    qd: Scalars
    tau: Scalars
    own_rates: Scalars
    added: Upper | None
    switches: Switches
    given: Scalars | None


def applied(t: Array, y: Integrated, args: Args, schedule: Schedules) -> Forcing:
    y, given = followed(y, args, schedule)
    tau, own_rates, switches = efforts(t, y, args, schedule)
    delta, qd, *_ = y
    added, bias = _added_at(t, delta, qd, args)
    if bias is not None:
        tau = minus(tau, tuple(bias))
    if given is not None:
        m = with_added(added, equations(args.constants, delta, qd))
        tau = minus(tau, times(m.mass, given))
    return Forcing(delta, qd, tau, own_rates, added, switches, given)


def _added_at(
    t: Array, delta: Scalars, qd: Scalars, args: Args
) -> tuple[Upper | None, Array | None]:
    """Returns the inertia that elements add, and its bias; None without any."""
    if not inertial(args.forces):
        return None, None
    q = args.q0 + jnp.stack(delta)
    return _added(args.linkage, args.masses(t), q, jnp.stack(qd))


_added: Any = eqx.filter_jit(added_inertia)  # traced once, not at each use by a solver


def health_at(losses: Scalars) -> Health:
    """Returns these losses of accuracy as a health: 0 if too much is lost."""
    least = LEAST_INERTIA_RATIO[losses[0].dtype]
    # Exactly, no loss is below 1; that of a fixed pair is stored as 0.
    return tuple(
        jnp.where(loss * least > 1, 0, jnp.where(loss < 1, 1, loss)) for loss in losses
    )


def health_with(rates: PyTree, health: Health) -> Health:
    return health_if(jnp.isfinite(sum(jax.tree.leaves(rates))), health)


def vector_field(t, y, args, schedule) -> Integrated:
    """Rates of displacements, velocities and the elements' own states."""
    at = applied(t, y, args, schedule)
    qd, qdd = rates(args.moving(), at.delta, at.qd, at.tau, at.added)
    return whole(qd, _with(at.given, qdd), at.own_rates)


def _with(given: Scalars | None, qdd: Scalars) -> Scalars:
    """Adds prescribed accelerations to those of other joints."""
    return qdd if given is None else tuple(map(operator.add, qdd, given))


def watched_field(t, y, args, schedule) -> tuple[Integrated, Health]:
    """Rates, and their health as in `ScheduledTerm`."""
    at = applied(t, y, args, schedule)
    (qd, qdd), losses = rates_and_conditioning(
        args.moving(), at.delta, at.qd, at.tau, at.added
    )
    qdd = _with(at.given, qdd)
    health = health_with((qdd, at.own_rates), health_at(losses))
    return whole(qd, qdd, at.own_rates), health


def health_of(t, y, args) -> Health:
    """Health of the equations at each joint, as in `ScheduledTerm`."""
    if prescribed(args.forces) is not None:
        y, _ = followed(y, args, schedule_of(t, args))
    delta, qd, *_ = y
    added, _ = _added_at(t, delta, tuple(map(jnp.zeros_like, qd)), args)
    return health_at(conditioning(args.moving(), delta, added))


def total_effort(
    linkage: Linkage, forces: tuple[Element, ...], t: Array, q: Array, qd: Array
) -> Array:
    """Sums the elements' efforts in their initial states [N or N m]."""
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
    """Returns an element's effort; raises ValueError unless it is n real numbers."""
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
    place = "until" if isinstance(element, Until) else f"forces[{index}]"
    with naming(place), switches.dealt():
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
