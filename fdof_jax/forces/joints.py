"""Force elements in the joints: dampers, springs, efforts and stops."""

import jax
import jax.numpy as jnp
from jax import Array

from ..base.checks import JOINT
from ..linkage.fields import Values, each, field
from ..linkage.linkage import Linkage
from .element import ScalarElement
from .switches import switch


class JointDamper(ScalarElement):
    """Viscous damping of the real joints, as in Fig 3: -coefficient * qd.

    **Arguments:** `coefficient`: one per joint or one for all, not negative [N s/m or N
    m s/rad].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.JointDamper([1, 2, 3])(0.0, [0, 0, 0], [1.0, 1.0, 1.0], arm).tolist()
    [-1.0, -2.0, -3.0]
    """

    coefficient: Values = field(unit="N s/m or N m s/rad", minimum=0)

    def respond(self, scheduled, q, qd, linkage):
        return tuple(-c * rate for c, rate in zip(each(self.coefficient, qd), qd))


class JointSpring(ScalarElement):
    """Linear springs in the joints: -stiffness * (q - rest).

    Angles are never wrapped: a spring that is wound up by a turn unwinds.

    **Arguments:** one value per joint or one for all.

    - `stiffness`: not negative [N/m or N m/rad].
    - `rest`: positions at which the springs are slack [m or rad].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> springs = fj.forces.JointSpring([10, 20, 30], rest=0.5)
    >>> springs(0.0, [0.0, 1.0, 0.5], [0.0, 0.0, 0.0], arm).tolist()
    [5.0, -10.0, 0.0]
    """

    stiffness: Values = field(unit="N/m or N m/rad", minimum=0)
    rest: Values = field(unit="m or rad", default=0.0)

    def respond(self, scheduled, q, qd, linkage):
        rows = zip(each(self.stiffness, q), each(self.rest, q), q)
        return tuple(-stiffness * (x - rest) for stiffness, rest, x in rows)

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        return jnp.sum(self.stiffness * (q - self.rest) ** 2) / 2


class JointEffort(ScalarElement):
    """Constant joint efforts, the paper's F and T inputs.

    **Arguments:** `tau`: one per joint or one for all [N or N m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> hold = fj.JointEffort(fj.analysis.holding_efforts(arm, [0, 0, 0]))
    >>> hold(0.0, [0, 0, 0], [0, 0, 0], arm).tolist()
    [58.86, 29.43, 9.81]
    """

    tau: Values = field(unit="N or N m")

    def respond(self, scheduled, q, qd, linkage):
        return each(self.tau, q)


class EffortHistory(ScalarElement):
    """Joint efforts given at times: linear in between, constant before and after.

    Adaptive steps end at the times; fixed ones may pass over them.

    **Arguments:** `ts`: increasing times, one or more [s]; `tau`: the efforts at `ts`,
    (time, joint) [N or N m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> history = fj.forces.EffortHistory([0, 1], [[0, 0, 0], [2, 4, 6]])
    >>> history(0.5, [0, 0, 0], [0, 0, 0], arm).tolist()
    [1.0, 2.0, 3.0]
    """

    ts: Values = field((None,), unit="s")
    tau: Values = field((None, JOINT), unit="N or N m")

    def conditions(self):
        yield from self.over_times("tau", 1)

    @property
    def jump_ts(self) -> Array:
        return self.ts

    def schedule(self, t, linkage):
        columns = jax.vmap(lambda tau: jnp.interp(t, self.ts, tau), in_axes=1)(self.tau)
        return tuple(columns)

    def respond(self, scheduled, q, qd, linkage):
        return scheduled


class JointStops(ScalarElement):
    """Stops at the ends of the joints' ranges: stiff springs that push one way.

    At a penetration p the effort is stiffness * p * (1 + damping * rate), never less
    than 0; the rate is that of the joint, outwards. Steps end where contact begins and
    ends. Rigid `HardStops` need no short steps.

    With `smoothing`, p is a parabola within that distance on both sides of the end of
    the range; at the end itself, p is a quarter of `smoothing`. Impacts lose as much
    energy as without it.

    **Arguments:** one per joint or one for all.

    - `lower`, `upper`: ends of the range [m or rad]; may be infinite.
    - `stiffness`: positive [N/m or N m/rad].
    - `damping`: not negative [s/m or s/rad].
    - `smoothing`: positive [m or rad]; by default none.

    **Raises:** ValueError for malformed arguments, and unless lower < upper.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> stops = fj.forces.JointStops(-1.0, 1.0, stiffness=1e4)
    >>> stops(0.0, [0.0, 1.01, -1.01], [0, 0, 0], arm).tolist()
    [0.0, -100.0, 100.0]
    """

    lower: Values = field(unit="m or rad", finite=False)
    upper: Values = field(unit="m or rad", finite=False)
    stiffness: Values = field(unit="N/m or N m/rad", above=0, default=1e4, kw_only=True)
    damping: Values = field(unit="s/m or s/rad", minimum=0, default=0.0, kw_only=True)
    smoothing: Values | None = field(
        unit="m or rad", above=0, default=None, kw_only=True
    )

    def conditions(self):
        yield from self.ordered("lower", "upper")

    def respond(self, scheduled, q, qd, linkage):
        values = self.lower, self.upper, self.stiffness, self.damping
        width = self.smoothing
        widths = [None] * len(q) if width is None else each(width, q)
        rows = zip(q, qd, *(each(value, q) for value in values), widths)
        return tuple(
            _push(low - x, -rate, k, d, width) - _push(x - high, rate, k, d, width)
            for x, rate, low, high, k, d, width in rows
        )

    def potential_energy(self, q: Array, linkage: Linkage) -> Array:
        below = _stored(self.lower - q, self.smoothing)
        above = _stored(q - self.upper, self.smoothing)
        return jnp.sum(self.stiffness * (below + above))


def _push(depth, rate, stiffness, damping, width):
    """Force of a stop at a depth, which is negative outside of the stop."""
    # By the rate of the joint, not of the penetration, which rounding makes slower. So
    # v dv / (1 + damping v) = -stiffness / mass p dx: the loss does not depend on p.
    damped = 1 + damping * rate
    pushing = switch(damped, damped, 0, continuous=True)
    return stiffness * _penetration(depth, width) * pushing


def _penetration(depth, width):
    """Returns the penetration at a depth."""
    if width is None:
        # Not called continuous: derivatives then correct even what the time of the
        # contact, as located, is off by, which matters at stiff stops.
        return switch(depth, depth, 0)
    near, beyond = _parts(depth, width)
    return near**2 / (4 * width) + beyond


def _parts(depth, width):
    """Splits the depth into the parts within the parabola and beyond it."""
    # jnp.clip would multiply the derivative in an infinite end of a range by 0.
    passed = lambda a: switch(depth + a, True, False, continuous=True)
    deep, touching = passed(-width), passed(width)
    near = jnp.where(deep, 2 * width, jnp.where(touching, depth + width, 0))
    return near, jnp.where(deep, depth - width, 0)


def _stored(depth, width):
    """Integral of the penetration over the depth."""
    if width is None:
        return jnp.where(depth > 0, depth, 0) ** 2 / 2
    near, beyond = _parts(depth, width)
    return near**3 / (12 * width) + beyond * (beyond / 2 + width)
