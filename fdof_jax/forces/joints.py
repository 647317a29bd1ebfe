"""Efforts in the joints themselves: damping, constant efforts, histories."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import increasing, real_array
from ..linkage.linkage import Linkage
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

    coefficient: Float[Array, " joint"]

    def __init__(self, coefficient: ArrayLike):
        self.coefficient = real_array(
            "coefficient", coefficient, (3,), minimum=0, broadcast=True
        )

    def respond(self, scheduled, q, qd, linkage):
        return tuple(-c * rate for c, rate in zip(self.coefficient, qd))

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Repeats the constructor's checks, which `equinox.tree_at` bypasses."""
        JointDamper(self.coefficient)

    def possible(self) -> Array:
        """Returns whether the coefficients are not negative."""
        return (self.coefficient >= 0).all()


class JointEffort(ScalarElement):
    """Constant joint efforts, the paper's F and T inputs.

    **Arguments:** `tau`: one per joint [N or N m].

    **Raises:** ValueError for malformed efforts.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> hold = fj.JointEffort(fj.holding_efforts(arm, [0, 0, 0]))
    >>> hold(0.0, [0, 0, 0], [0, 0, 0], arm).tolist()
    [58.86, 29.43, 9.81]
    """

    tau: Float[Array, " joint"]

    def __init__(self, tau: ArrayLike):
        self.tau = real_array("tau", tau, (3,))

    def respond(self, scheduled, q, qd, linkage):
        return tuple(self.tau)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Repeats the constructor's checks, which `equinox.tree_at` bypasses."""
        JointEffort(self.tau)


class EffortHistory(ScalarElement):
    """Joint efforts given at times: linear in between, constant before and after.

    Steps need not end at the times. Adaptive steps sample the efforts only at their
    stages, and do not control the error of derivatives. For gradients in `tau`, bound
    the steps to the distance of two samples (`diffrax.PIDController(..., dtmax=...)`).

    **Arguments:** `ts`: increasing times, one or more [s]; `tau`: the efforts at `ts`,
    (time, 3) [N or N m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> history = fj.EffortHistory([0, 1], [[0, 0, 0], [2, 4, 6]])
    >>> history(0.5, [0, 0, 0], [0, 0, 0], arm).tolist()
    [1.0, 2.0, 3.0]
    """

    ts: Float[Array, " time"]
    tau: Float[Array, "time joint"]

    def __init__(self, ts: ArrayLike, tau: ArrayLike):
        self.ts = real_array("ts", ts, (None,))
        increasing("ts", self.ts)
        self.tau = real_array("tau", tau, (self.ts.size, 3))

    def schedule(self, t, linkage):
        """Returns the efforts at a time."""
        columns = jax.vmap(lambda tau: jnp.interp(t, self.ts, tau), in_axes=1)(self.tau)
        return tuple(columns)

    def respond(self, scheduled, q, qd, linkage):
        return scheduled

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Repeats the constructor's checks, which `equinox.tree_at` bypasses."""
        EffortHistory(self.ts, self.tau)

    def possible(self) -> Array:
        """Returns whether the times increase."""
        return (self.ts[1:] > self.ts[:-1]).all()
