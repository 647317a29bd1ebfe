"""PD control of the joints with limited efforts, as in Fig 7, and gains for it."""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import real_array
from ..dynamics import mass_matrix
from ..forces.element import Forces, ScalarElement
from ..forces.switches import clip
from ..linkage.fields import Values, called, each, field
from ..linkage.linkage import Linkage, joints_of, without_fixed
from ..mechanics.equations import Scalars
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

    def schedule(self, t: Array, linkage: Linkage) -> Scalars:
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
        self,
        scheduled: Sequence[Array],
        q: Scalars | Array,
        qd: Scalars | Array,
        linkage: Linkage,
    ) -> Scalars:
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


def gains_from_frequency(
    linkage: Linkage,
    q: ArrayLike,
    frequency: ArrayLike,
    damping_ratio: ArrayLike,
    forces: Forces = (),
) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
    """Computes the gains of PD control for given natural frequencies and damping.

    The gains are kp = frequency^2 M_kk and kd = 2 damping_ratio frequency M_kk, with
    the inertia M_kk that joint k moves at `q` while the other joints stand still. A
    joint then has exactly this frequency and damping if it moves alone, without gravity
    and without springs or dampers. `closed_loop_modes` shows the modes of all joints
    together, under all forces. The gains of `ComputedTorque` are frequency^2 and
    2 damping_ratio frequency themselves.

    **Arguments:**

    - `linkage`, `q`: the arm and its joint positions [m or rad].
    - `frequency`: natural frequencies, one per joint or one for all, positive [rad/s].
    - `damping_ratio`: one per joint or one for all, not negative.
    - `forces`: elements, of which those with masses count.

    **Returns:** `kp` [N/m or N m/rad] and `kd` [N s/m or N m s/rad], 0 at fixed pairs.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> kp, kd = fj.control.gains_from_frequency(
    ...     arm, [0, 0, 0], frequency=[5, 5, 10], damping_ratio=0.7)
    >>> kp.tolist(), kd.tolist()  # of 14, 5 and 1 kg m^2
    ([350.0, 125.0, 100.0], [98.0, 35.0, 14.0])
    """
    inertia = mass_matrix(linkage, q, forces).diagonal()
    n = joints_of(linkage)
    of_joints = partial(real_array, shape=(n,), broadcast=True, of=f"{n} joints")
    frequency = of_joints("frequency", frequency, above=0, unit="rad/s")
    damping_ratio = of_joints("damping_ratio", damping_ratio, minimum=0)
    kp, kd = frequency**2 * inertia, 2 * damping_ratio * frequency * inertia
    return without_fixed(linkage, kp), without_fixed(linkage, kd)
