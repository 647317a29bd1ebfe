"""Samples of a controller in discrete time, and what acts between them."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from ..base.checks import real_array
from ..forces.element import Element, Forces
from ..linkage.fields import Truth, has_come
from ..linkage.linkage import Linkage, joints_of, without_fixed
from ..steps.landing import Clock


class SampleState(NamedTuple):
    """The state of a controller between its samples.

    - `taken`: number of samples so far; `memory`: the controller's own state.
    - `command` (n,): the last one; `acting` (n,): the one that acts [N or N m].
    - `under_way` (command, n): the last ones in a ring; None if delays are below a
      period.
    - `arrived`: how many began to act between samples; None if they act at samples.
    """

    taken: Array
    memory: PyTree
    command: Array
    acting: Array
    under_way: Array | None
    arrived: Array | None


class ClockElement(Element):
    """An element without efforts of its own, at whose times steps end."""

    clock: Clock

    @property
    def jump_ts(self) -> None:
        """None: `clock` has the times; a controller's own do not matter."""

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        return jnp.zeros_like(q)


class Arrivals(ClockElement):
    """Times at which commands begin to act, if not at samples."""


class Sampler(ClockElement):
    """A controller that samples once per period, as an element.

    - `control`: the controller; `clock`: that of the samples.
    - `noise`: that of the measured state, a row per sample; or None.
    - `late`: delay of a command in periods, at most `most`; `rest`: delay beyond these
      [s], None if commands begin to act at samples. Otherwise the element before is
      `Arrivals`.
    """

    control: Element
    noise: tuple[Array, Array] | None  # of positions, of velocities
    rest: Float[Array, ""] | None
    late: Array | int
    most: int = eqx.field(static=True)

    def unsampled(self, linkage: Linkage) -> SampleState:
        memory = self.control.initial_state(linkage)
        none, tau = jnp.zeros((), int), jnp.zeros(joints_of(linkage))
        before = SampleState(
            taken=none,
            memory=jax.tree.map(lambda leaf: jnp.asarray(leaf, float), memory),
            command=tau,
            acting=tau,
            under_way=jnp.zeros((self.most + 1, tau.size)) if self.most else None,
            arrived=None,
        )
        if self.rest is None:
            return before
        acting = jnp.where(self.rest >= 0, tau, jnp.nan)
        return before._replace(acting=acting, arrived=none)

    def sampled(
        self, q: Array, qd: Array, linkage: Linkage, before: SampleState
    ) -> SampleState:
        k, under_way = before.taken, before.under_way
        if self.noise is not None:
            q, qd = (value + rows[k] for value, rows in zip((q, qd), self.noise))
        at = self.clock.at(k), q, qd, linkage, before.memory
        tau, rates = self.control.act(*at)
        tau = without_fixed(linkage, real_array("control", tau, q.shape))
        acting = tau
        if under_way is not None:
            under_way = under_way.at[k % len(under_way)].set(tau)
            acting = under_way[(k - self.late) % len(under_way)]
        euler = lambda memory, rate: memory + self.clock.period * rate
        return before._replace(
            taken=k + 1,
            memory=jax.tree.map(euler, before.memory, rates),
            command=tau,
            acting=acting if before.arrived is None else before.acting,
            under_way=under_way,
        )

    def arriving(self, before: SampleState) -> SampleState:
        """Returns what holds after a command begins to act."""
        assert before.arrived is not None
        tau = before.command
        if before.under_way is not None:
            tau = before.under_way[(before.arrived - self.late) % len(before.under_way)]
        return before._replace(acting=tau, arrived=before.arrived + 1)


def sampler_of(forces: Forces) -> Sampler | None:
    found = [element for element in forces if isinstance(element, Sampler)]
    return found[0] if found else None


def unsampled(forces: Forces, linkage: Linkage) -> SampleState | None:
    """Returns what holds before the first sample, None without a controller."""
    sampler = sampler_of(forces)
    return None if sampler is None else sampler.unsampled(linkage)


def after_samples(
    sampler: Sampler, clocks: tuple[Array, Array], q: Array, qd: Array,
    linkage: Linkage, before: SampleState,
) -> tuple[SampleState, Truth]:  # fmt: skip
    """Returns what holds after samples and arrivals at a time, and whether any came."""
    of_arrivals, of_samples = clocks
    clock: Any = sampler.clock
    time = clock.at(before.taken)
    due = (before.taken < clock.number) & has_come(time, of_samples)
    after = jax.lax.cond(
        due, lambda: sampler.sampled(q, qd, linkage, before), lambda: before
    )
    if before.arrived is None:
        return after, due
    time = clock.at(before.arrived) + sampler.rest
    comes = (before.arrived < after.taken) & has_come(time, of_arrivals)
    after = jax.lax.cond(comes, lambda: sampler.arriving(after), lambda: after)
    return after, due | comes
