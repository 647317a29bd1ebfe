"""The equations as steps know them: rates, switches, modes, samples, health."""

import functools
import operator
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

# Equations have their own types (`simulation.vector_field.Args`), unknown to steps.
Integrated = PyTree  # a state: positions, rates, the elements' own
Arguments = PyTree  # of the equations: a named tuple with a linkage, q0 and sides
Term = Any  # a `ScheduledTerm`
Health = tuple[Array, ...]  # one per joint, see `ScheduledTerm`


class ScheduledTerm(diffrax.ODETerm):
    """A term whose vector field takes a fourth argument, which depends on time alone.

    - `schedule(t, args)` computes this argument, in steps at all `SCHEDULE_SHARES`.
    - `health(t, y, args)` is the loss of accuracy in the rates of each joint, at least
      1, or 0 where the equations are singular.
    - `watched_field` returns the rates and their health, NaN if they are not finite.
    - `switching` returns the switching functions (n,), and with which something jumps.

    Each may be None:

    - `unknown_modes(args)` returns the modes before the start, and how many of the last
      switching functions guard them: positive while a mode lasts.
    - `resolve(event, y, args)` returns the state and the modes after an event.
    - `settle(t, y, args)` returns the state after a jump of prescribed velocities.
    - `sample(t, y, args)` returns a new `args.sampled`, of a controller, and whether it
      changed.
    """

    vector_field: Callable[..., PyTree] = eqx.field(static=True)
    schedule: Callable[..., PyTree] = eqx.field(static=True)
    health: Callable[..., Health] = eqx.field(static=True)
    watched_field: Callable[..., tuple[PyTree, Health]] = eqx.field(static=True)
    switching: Callable[..., tuple[Array, tuple[bool, ...]]] = eqx.field(static=True)
    unknown_modes: Callable | None = eqx.field(static=True, default=None)
    resolve: Callable | None = eqx.field(static=True, default=None)
    settle: Callable | None = eqx.field(static=True, default=None)
    sample: Callable | None = eqx.field(static=True, default=None)

    def vf(self, t, y, args):
        return self.vector_field(t, y, args, self.schedule(t, args))

    def switches(self, t, y, args) -> tuple[Array, tuple[bool, ...]]:
        return self.switching(t, y, args, self.schedule(t, args))


def is_singular(health: Health) -> Array:
    return functools.reduce(operator.or_, (x == 0 for x in health))


def health_if(finite: Array, health: Health) -> Health:
    """Returns the health, NaN where rates are not finite unless they are singular."""
    return tuple(jnp.where(finite | (x == 0), x, jnp.nan) for x in health)
