"""References for tests of a controller: steps, pulses and ramps of the joints."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from ..forces import Condition, Values, field
from ..linkage import Linkage, joints_of
from ..references import Reference


class Step(Reference):
    """A step of the joints' positions at a known time.

    The velocity is 0: a derivative gain acts on the arm's velocity alone.

    **Arguments:** positions are one per joint, or one for all.

    - `before`, `after`: the positions before the step, and from then on [m or rad].
    - `begin`: the time of the step [s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.double_pendulum().linkage
    >>> step = fj.references.Step(0.0, [0.3, -0.1], begin=0.5)
    >>> [step(t, arm)[0].tolist() for t in (0.4, 0.5)]
    [[0.0, 0.0], [0.3, -0.1]]
    """

    before: Values = field(unit="m or rad")
    after: Values = field(unit="m or rad")
    begin: Values = field((), unit="s", default=0.0, kw_only=True)

    def conditions(self):
        yield _of_one_length(before=self.before, after=self.after)

    @property
    def jump_ts(self) -> Array:
        return self.begin[None]

    def __call__(self, t: Any, linkage):
        return _standing(jnp.where(t < self.begin, self.before, self.after), linkage)


class Pulse(Reference):
    """A pulse of the joints' positions between two known times.

    **Arguments:** positions are one per joint, or one for all.

    - `outside`, `inside`: the positions outside of the pulse and during it [m or rad].
    - `begin`, `end`: its times, begin < end [s].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.double_pendulum().linkage
    >>> pulse = fj.references.Pulse(0.0, 0.2, begin=1.0, end=1.5)
    >>> [pulse(t, arm)[0].tolist() for t in (1.0, 1.5)]
    [[0.2, 0.2], [0.0, 0.0]]
    """

    outside: Values = field(unit="m or rad")
    inside: Values = field(unit="m or rad")
    begin: Values = field((), unit="s", kw_only=True)
    end: Values = field((), unit="s", kw_only=True)

    def conditions(self):
        yield from self.ordered("begin", "end")
        yield _of_one_length(outside=self.outside, inside=self.inside)

    @property
    def jump_ts(self) -> Array:
        return jnp.stack([self.begin, self.end])

    def __call__(self, t: Any, linkage):
        within = (self.begin <= t) & (t < self.end)
        return _standing(jnp.where(within, self.inside, self.outside), linkage)


class Ramp(Reference):
    """Positions given at times: linear in between, constant before and after.

    **Arguments:** `ts`: increasing times, two or more [s]; `q`: the positions at `ts`,
    (time, joint) [m or rad].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.double_pendulum().linkage
    >>> ramp = fj.references.Ramp([0, 2], [[0.0, 1.0], [0.5, 0.0]])
    >>> q, qd = ramp(1.0, arm)
    >>> q.tolist(), qd.tolist()
    ([0.25, 0.5], [0.25, -0.5])
    """

    ts: Values = field((None,), unit="s")
    q: Values = field((None, "joint"), unit="m or rad")

    def conditions(self):
        yield from self.over_times("q", 2)

    @property
    def jump_ts(self) -> Array:
        """The times, at which the velocities jump [s]."""
        return self.ts

    def __call__(self, t: Any, linkage):
        after = jnp.searchsorted(self.ts, t, side="right")
        k = jnp.clip(after, 1, len(self.ts) - 1)
        rates = (self.q[k] - self.q[k - 1]) / (self.ts[k] - self.ts[k - 1])
        q = self.q[k - 1] + (t - self.ts[k - 1]) * rates
        before, behind = after == 0, after == len(self.ts)
        q = jnp.where(before, self.q[0], jnp.where(behind, self.q[-1], q))
        return q, jnp.where(before | behind, 0, rates)


def _of_one_length(**positions: Array) -> Condition:
    (first, other), (one, two) = positions, map(jnp.shape, positions.values())
    fits = one == two or () in (one, two)
    return Condition(fits, other, f"as many numbers as {first}", (one, two))


def _standing(q: Array, linkage: Linkage) -> tuple[Array, Array]:
    q = jnp.broadcast_to(q, joints_of(linkage))
    return q, jnp.zeros_like(q)
