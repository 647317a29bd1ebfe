"""Joint control of the third example (Fig 7): saturated PD."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checks import real_array
from ..forces.element import ScalarElement
from ..linkage.linkage import Linkage
from .reference import Reference, checked_reference, reference_motion


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

    kp: Float[Array, " joint"]
    kd: Float[Array, " joint"]
    limit: Float[Array, " joint"]
    reference: Reference

    # Units of (kp, kd) by the kind of joint.
    gain_units: ClassVar = {"R": ("N m/rad", "N m s/rad"), "P": ("N/m", "N s/m")}

    def __init__(
        self,
        kp: ArrayLike,
        kd: ArrayLike,
        limit: ArrayLike,
        reference: Reference,
    ):
        self.kp = real_array("kp", kp, (3,), minimum=0, broadcast=True)
        self.kd = real_array("kd", kd, (3,), minimum=0, broadcast=True)
        self.limit = real_array(
            "limit", limit, (3,), minimum=0, finite=False, broadcast=True
        )
        self.reference = checked_reference(reference)

    def schedule(self, t: Array, linkage: Linkage) -> tuple[Any, ...]:
        """The reference motion (q_ref, qd_ref), independent of the state."""
        return reference_motion(self.reference, t, linkage)

    def respond(self, scheduled, q, qd, linkage):
        # At the limit, jnp.clip's derivative would be the mean of both sides.
        return tuple(
            jnp.where(jnp.abs(effort) <= limit, effort, jnp.clip(effort, -limit, limit))
            for effort, limit in zip(
                self.unlimited(scheduled, q, qd, linkage), self.limit
            )
        )

    def unlimited(
        self, scheduled: Any, q: Any, qd: Any, linkage: Linkage
    ) -> tuple[Array, ...]:
        """The efforts before clipping; a subclass adds to them."""
        return tuple(
            kp * (position - q) + kd * (velocity - qd)
            for kp, kd, position, velocity, q, qd in zip(
                self.kp, self.kd, *scheduled, q, qd
            )
        )

    def demand(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        """The efforts before clipping, (3,) [N or N m]."""
        return jnp.stack(self.unlimited(self.schedule(t, linkage), q, qd, linkage))

    @property
    def jump_ts(self) -> Array | None:
        """Times at which the reference jumps [s], or None."""
        return getattr(self.reference, "jump_ts", None)

    def check(self, linkage: Linkage, ts: Array) -> None:
        """Repeats the constructor's checks, then runs the reference's check, if any."""
        # `equinox.tree_at` changes values without calling the constructor.
        PDController(self.kp, self.kd, self.limit, self.reference)
        check_reference: Any = getattr(self.reference, "check", None)
        if check_reference is not None:
            check_reference(linkage, ts)

    def possible(self) -> Array:
        """Returns whether gains and limits are not negative."""
        return ((self.kp >= 0) & (self.kd >= 0) & (self.limit >= 0)).all()
