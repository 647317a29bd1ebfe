"""Efforts in the joints themselves: damping, constant efforts, histories."""

import jax
import jax.numpy as jnp
from jax import Array

from ..base.checks import JOINT
from ..linkage.fields import Condition, Values, each, field
from .element import ScalarElement


class JointDamper(ScalarElement):
    """Viscous damping of the real joints, as in Fig 3: -coefficient * qd.

    At a revolute joint, `qd` is the relative rate, and the preceding link takes the
    reaction.

    **Arguments:** `coefficient`: one for all joints or one per joint, not negative
    [N s/m or N m s/rad].

    **Raises:** ValueError for malformed or negative coefficients.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> fj.JointDamper([1, 2, 3])(0.0, [0, 0, 0], [1.0, 1.0, 1.0], arm).tolist()
    [-1.0, -2.0, -3.0]
    """

    coefficient: Values = field(unit="N s/m or N m s/rad", minimum=0)

    def respond(self, scheduled, q, qd, linkage):
        return tuple(-c * rate for c, rate in zip(each(self.coefficient, qd), qd))


class JointEffort(ScalarElement):
    """Constant joint efforts, the paper's F and T inputs.

    **Arguments:** `tau`: one for all joints or one per joint [N or N m].

    **Raises:** ValueError for malformed efforts.

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
        times, efforts = len(self.ts), len(self.tau)
        rising = (self.ts[1:] > self.ts[:-1]).all() & (times > 0)
        yield Condition(rising, "ts", "increasing times", (self.ts,))
        same = times == efforts
        yield Condition(same, "tau", f"{times} rows, one per time", (efforts,))

    @property
    def jump_ts(self) -> Array:
        """The times, at which the efforts have kinks [s]."""
        return self.ts

    def schedule(self, t, linkage):
        columns = jax.vmap(lambda tau: jnp.interp(t, self.ts, tau), in_axes=1)(self.tau)
        return tuple(columns)

    def respond(self, scheduled, q, qd, linkage):
        return scheduled
