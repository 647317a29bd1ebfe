"""PD control of the joints with limited efforts, as in the third example (Fig 7)."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array

from ..forces.element import ScalarElement
from ..forces.switches import clip
from ..linkage.fields import Values, called, each, field
from ..linkage.linkage import Linkage
from ..references.reference import EXPECTED, reference_motion


class PDController(ScalarElement):
    """Saturated PD control of the joints, as in Fig 7: a force element.

    The effort is kp * (q_ref - q) + kd * (qd_ref - qd), clipped to +-limit as a whole.
    The position error is never wrapped: a start one turn away unwinds. The derivative
    is zero for a demand beyond the limit, but not for a demand just at the limit.

    **Arguments:** one value per joint, in joint order, or one for all.

    - `kp`: proportional gains, not negative [N/m or N m/rad].
    - `kd`: gains of the error rate, not negative [N s/m or N m s/rad].
    - `limit`: largest effort [N or N m], may be infinite.
    - `reference`: a callable pytree, `(t, linkage) -> (q_ref, qd_ref)`.

    **Raises:** ValueError for malformed or negative gains and limits, and for a
    reference that is not callable.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> task = fj.CircleTask()
    >>> pd = fj.PDController(kp=100, kd=10, limit=30, reference=task)
    >>> q, qd = task(0.0, arm)
    >>> pd(0.0, q - 0.2, qd, arm).tolist(), pd(0.0, q - 0.5, qd, arm).tolist()
    ([20.0, 20.0, 20.0], [30.0, 30.0, 30.0])
    """

    kp: Values = field(unit="N/m or N m/rad", minimum=0)
    kd: Values = field(unit="N s/m or N m s/rad", minimum=0)
    limit: Values = field(unit="N or N m", minimum=0, finite=False)
    reference: Any = called(EXPECTED)

    # Units of (kp, kd) by the kind of joint.
    gain_units: ClassVar = {"R": ("N m/rad", "N m s/rad"), "P": ("N/m", "N s/m")}

    def schedule(self, t: Array, linkage: Linkage) -> tuple[Any, ...]:
        """The reference motion (q_ref, qd_ref), independent of the state."""
        return reference_motion(self.reference, t, linkage)

    def respond(self, scheduled, q, qd, linkage):
        return tuple(
            clip(effort, -limit, limit)
            for effort, limit in zip(
                self.unlimited(scheduled, q, qd, linkage), each(self.limit, q)
            )
        )

    def unlimited(
        self, scheduled: Any, q: Any, qd: Any, linkage: Linkage
    ) -> tuple[Array, ...]:
        """The efforts before clipping; a subclass adds to them."""
        return tuple(
            kp * (position - q) + kd * (velocity - qd)
            for kp, kd, position, velocity, q, qd in zip(
                each(self.kp, q), each(self.kd, q), *scheduled, q, qd
            )
        )

    def demand(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        """The efforts before clipping, (n,) [N or N m]."""
        return jnp.stack(self.unlimited(self.schedule(t, linkage), q, qd, linkage))
