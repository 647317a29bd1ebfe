"""The vector field of a linkage with force elements, as integrators call it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..forces.added_inertia import added_inertia, inertial
from ..forces.element import Element, ScalarElement, StatefulElement
from ..linkage.linkage import Linkage
from ..mechanics.equations import Constants, Upper, zeros
from ..mechanics.rates import conditioning, rates, rates_and_conditioning
from ..xla.callbacks import with_checks

# Below this inertia ratio the accelerations have six correct digits at best (float64)
# or two (float32), and rounding determines the adaptive steps.
LEAST_INERTIA_RATIO = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-5}


class Args(NamedTuple):
    linkage: Linkage
    q0: Array
    constants: Constants
    forces: tuple[Element, ...]


@with_checks
def schedule_of(t: Array, args: Args) -> tuple[Any, ...]:
    """Returns each element's schedule."""
    return tuple(element.schedule(t, args.linkage) for element in args.forces)


def stateful(forces: tuple[Element, ...]) -> list[StatefulElement]:
    """Returns the elements that have a state of their own."""
    return [element for element in forces if isinstance(element, StatefulElement)]


def own_states(args: Args, scalars: tuple[Array, ...]) -> list[Any]:
    """Rebuilds the states of the stateful elements from the integrated scalars."""
    states, place = [], 0
    for element in stateful(args.forces):
        shapes = jax.eval_shape(element.initial_state, args.linkage)
        leaves, structure = jax.tree.flatten(shapes)
        arrays = []
        for leaf in leaves:
            own = scalars[place : place + leaf.size]
            arrays.append(jnp.array(own).reshape(leaf.shape))
            place += leaf.size
        states.append(jax.tree.unflatten(structure, arrays))
    return states


def _scalars(tree: Any, dtype: Any) -> tuple[Array, ...]:
    leaves = [jnp.asarray(leaf, dtype).ravel() for leaf in jax.tree.leaves(tree)]
    return tuple(jnp.concatenate(leaves)) if leaves else ()


class Applied(NamedTuple):
    """Efforts of the force elements, rates of their states, and inertia they add."""

    tau: tuple[Array, ...]
    own_rates: tuple[Array, ...]
    added: Upper | None


@with_checks
def applied(t: Any, y: Any, args: Args, schedule: tuple[Any, ...]) -> Applied:
    """Evaluates the force elements; builds arrays only where an element needs them."""
    delta, qd, *own = y
    states = iter(own_states(args, *own) if own else ())
    tau, own_rates = None, []
    arrays = lambda: (args.q0 + jnp.stack(delta), jnp.stack(qd))
    for index, (element, scheduled) in enumerate(zip(args.forces, schedule)):
        if isinstance(element, ScalarElement):
            q = tuple(a + b for a, b in zip(args.q0, delta))
            effort = element.respond(scheduled, q, qd, args.linkage)
        else:
            state = next(states) if isinstance(element, StatefulElement) else ()
            effort, rate = element_effort(
                index, element, t, *arrays(), args.linkage, state
            )
            own_rates += _scalars(rate, args.q0.dtype)
        tau = effort if tau is None else tuple(a + b for a, b in zip(tau, effort))
    tau = zeros(args.q0) if tau is None else tuple(tau)
    if not inertial(args.forces):
        return Applied(tau, tuple(own_rates), None)
    added, bias = _added(args.linkage, inertial(args.forces), *arrays())
    tau = tuple(a - b for a, b in zip(tau, bias))
    return Applied(tau, tuple(own_rates), added)


_added: Any = eqx.filter_jit(added_inertia)  # traced once, not at each use by a solver


def vector_field(t, y, args, schedule) -> tuple[Any, ...]:
    """Rates of joint displacements, of velocities and of the elements' own states."""
    delta, qd, *own = y
    acting = applied(t, y, args, schedule)
    moving = rates(args.constants, delta, qd, acting.tau, acting.added)
    return (*moving, acting.own_rates) if own else moving


def watched_field(t, y, args, schedule) -> tuple[tuple[Any, ...], Array]:
    """Rates of `vector_field` and their health, which `ScheduledTerm` defines."""
    delta, qd, *own = y
    acting = applied(t, y, args, schedule)
    (qd, qdd), loss = rates_and_conditioning(
        args.constants, delta, qd, acting.tau, acting.added
    )
    finite = jnp.isfinite(sum((*qdd, *acting.own_rates)))
    health = jnp.where(loss * LEAST_INERTIA_RATIO[loss.dtype] > 1, 0, loss)
    # A singular matrix also makes accelerations not finite; health 0 prevails.
    health = jnp.where(finite | (health == 0), health, jnp.nan)
    return ((qd, qdd, acting.own_rates) if own else (qd, qdd)), health


def health_of(t, y, args) -> Array:
    """Health of the equations: positive, or 0 where they are singular."""
    delta, *_ = y
    added = None
    if inertial(args.forces):
        q = args.q0 + jnp.stack(delta)
        still = jnp.zeros_like(q)
        added, _ = _added(args.linkage, inertial(args.forces), q, still)
    loss = conditioning(args.constants, delta, added)
    return jnp.where(loss * LEAST_INERTIA_RATIO[loss.dtype] > 1, 0, loss)


@eqx.filter_jit  # traced once, not at each use by a solver
def element_effort(
    index: int,
    element: Element,
    t: Array,
    q: Array,
    qd: Array,
    linkage: Linkage,
    state: Any,
) -> tuple[Array, Any]:
    """Returns an element's effort and the rate of its state, () without a state.

    Raises ValueError unless the effort is three real numbers.
    """
    expected = f"forces[{index}]: expected it to return tau, an array of 3 real numbers"
    found: Any = element.act(t, q, qd, linkage, state)
    if not isinstance(found, tuple) or len(found) != 2:
        raise ValueError(f"{expected}, and the rate of its state, got {found!r}.")
    tau, rate = found
    if jax.tree.map(jnp.shape, rate) != jax.tree.map(jnp.shape, state):
        raise ValueError(
            f"forces[{index}]: expected the rate of its state to be like the state, "
            f"{state!r}, got {rate!r}."
        )
    try:
        tau = jnp.asarray(tau)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{expected}, got {tau!r}.") from error
    if tau.shape != (3,) or tau.dtype.kind not in "iuf":
        raise ValueError(f"{expected}, got shape {tau.shape} and dtype {tau.dtype}.")
    return tau.astype(q.dtype), rate


def initial_own(args: Args, own0: Any = None) -> tuple[tuple[Array, ...], ...]:
    """Returns the elements' initial states as scalars: `own0`, or their defaults."""
    if own0 is None:
        own0 = [e.initial_state(args.linkage) for e in stateful(args.forces)]
    return (_scalars(own0, args.q0.dtype),) if own0 else ()
