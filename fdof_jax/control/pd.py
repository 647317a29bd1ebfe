"""PD control of the joints, also with a model of the arm, and its gains."""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..base.checks import real_array
from ..dynamics import mass_matrix
from ..forces.element import Forces, ScalarElement
from ..forces.switches import clip
from ..linkage.fields import Condition, Truth, Values, called, each, field
from ..linkage.frames import scalar_frames
from ..linkage.linkage import Linkage, check_linkage, joints_of, possible, without_fixed
from ..mechanics.equations import Scalars, link_constants, where
from ..mechanics.rates import required_efforts
from ..references.reference import EXPECTED, reference_motion


class PDController(ScalarElement):
    """Saturated PD control of the joints, as in Fig 7: a force element.

    The effort is kp * (q_ref - q) + kd * (qd_ref - qd), clipped to +-limit as a whole.
    The position error is never wrapped: a start one turn away unwinds. The derivative
    is zero for a demand beyond the limit, but not just at it.

    **Arguments:** one value per joint or one for all.

    - `kp`: proportional gains, not negative [N/m or N m/rad].
    - `kd`: gains of the error rate, not negative [N s/m or N m s/rad].
    - `limit`: largest effort [N or N m], may be infinite.
    - `reference`: a callable pytree, `(t, linkage) -> (q_ref, qd_ref)`.

    **Raises:** ValueError for malformed arguments.

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
        """Returns the reference motion (q_ref, qd_ref), independent of the state."""
        return reference_motion(self.reference, t, linkage)

    def respond(self, scheduled, q, qd, linkage):
        efforts = self.unlimited(scheduled, q, qd, linkage)
        rows = zip(efforts, each(self.limit, q))
        return tuple(clip(effort, -limit, limit) for effort, limit in rows)

    def unlimited(
        self,
        scheduled: Sequence[Array],
        q: Scalars | Array,
        qd: Scalars | Array,
        linkage: Linkage,
    ) -> Scalars:
        """Computes the efforts before clipping; a subclass adds to them."""
        rows = zip(each(self.kp, q), each(self.kd, q), *scheduled, q, qd)
        return tuple(
            kp * (position - q) + kd * (velocity - qd)
            for kp, kd, position, velocity, q, qd in rows
        )

    def demand(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        """Computes the efforts before clipping, (n,) [N or N m]."""
        return jnp.stack(self.unlimited(self.schedule(t, linkage), q, qd, linkage))


class ModelBased(PDController):
    model: Linkage | None = None

    def __check_init__(self):
        if self.model is None:
            return
        try:
            check_linkage(self.model)
        except ValueError as error:
            raise ValueError(f"model{str(error).removeprefix('linkage')}") from None

    def _believed(self, linkage: Linkage) -> Linkage:
        return linkage if self.model is None else self.model

    def conditions_on(self, linkage):
        wanted, found = linkage.ef, self._believed(linkage).ef
        same = wanted.shape == found.shape and (wanted == found).all()
        expected = f"the arm's own topology, existence factors {wanted}"
        yield Condition(same, "model", expected, found)

    def check(self, linkage: Linkage, ts: Array) -> None:
        super().check(linkage, ts)
        ModelBased.__check_init__(self)

    def possible(self) -> Truth:
        own = super().possible()
        return own if self.model is None else own & possible(self.model)


class GravityFeedforward(ModelBased):
    """PD control plus the efforts that hold the arm's weight: a force element.

    To the effort of a `PDController` it adds the effort that holds the arm at rest
    where it is. The sum is clipped to +-limit [N or N m].

    **Arguments:**

    - `kp`, `kd`, `limit`, `reference`: as in `PDController`.
    - `model`: the controller's model of the arm, by default the arm itself. It lacks
      masses of other force elements, such as a load.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> task = fj.CircleTask()
    >>> q, qd = task(0.0, arm)  # no error is left to correct
    >>> fj.control.GravityFeedforward(500, 50, 500, task)(0.0, q, qd, arm).tolist()
    [-93.195, 0.0, 0.0]
    >>> fj.analysis.holding_efforts(arm, q).tolist()
    [-93.195, 0.0, 0.0]
    """

    def unlimited(self, scheduled, q, qd, linkage):
        errors = super().unlimited(scheduled, q, qd, linkage)
        held = _held(self._believed(linkage), q)
        return tuple(a + b for a, b in zip(errors, held))


def _held(linkage: Linkage, q: Scalars | Array) -> Scalars:
    """The efforts that hold the arm at rest against gravity, in joint order."""
    start, direction, *_, revolute = scalar_frames(linkage, q)
    # The mass beyond a joint, and its first moment in x about the ground pivot.
    mass, moment = jnp.zeros(()), jnp.zeros(())
    efforts = []
    for k in reversed(range(len(q))):
        along, across = linkage.com[k]
        e = direction[k + 1]
        center = start[k + 1].real + along * e.real - across * e.imag
        mass = mass + linkage.mass[k]
        moment = moment + linkage.mass[k] * center
        # A slide runs across the previous link: it rises as that link runs along x.
        turning = moment - mass * start[k + 1].real
        arm = jnp.where(revolute[k], turning, mass * direction[k].real)
        efforts.append(linkage.gravity * arm)
    return tuple(reversed(efforts))


class ComputedTorque(ModelBased):
    """Computed-torque control, by the inverse dynamics: a force element.

    The effort is M(q) (qdd_ref + kp e + kd de/dt) + bias(q, qd) with e = q_ref - q,
    clipped to +-limit as a whole. With an exact model and within the limits, the error
    of each joint obeys d2e/dt2 + kd de/dt + kp e = 0.

    **Arguments:** one value per joint or one for all.

    - `kp` [1/s^2], `kd` [1/s]: gains from errors to accelerations, not negative.
    - `limit`: largest effort [N or N m], may be infinite.
    - `reference`: as in `PDController`; differentiable in time. Jumps of its velocity
      give no impulses.
    - `model`: the controller's model of the arm, by default the arm itself. It lacks
      masses and efforts of other force elements, such as a load.

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig7().linkage
    >>> stand = fj.references.JointMove([1, 2, 0], [1, 2, 0], fj.references.Travel(1.0))
    >>> control = fj.control.ComputedTorque(kp=25, kd=10, limit=500, reference=stand)
    >>> tau = control(0.0, stand.end - 0.1, stand.end * 0, arm)
    >>> fj.forward_dynamics(arm, stand.end - 0.1, [0, 0, 0], tau).tolist()  # kp / 10
    [2.5, 2.5, 2.5]
    """

    gain_units: ClassVar = dict.fromkeys("RP", ("1/s^2", "1/s"))

    def schedule(self, t, linkage):
        t = real_array("t", t, ())
        motion = lambda t: reference_motion(self.reference, t, linkage)
        (q_ref, qd_ref), (_, qdd_ref) = jax.jvp(motion, (t,), (jnp.ones_like(t),))
        return q_ref, qd_ref, qdd_ref

    def unlimited(self, scheduled, q, qd, linkage):
        *motion, qdd_ref = scheduled
        errors = super().unlimited(motion, q, qd, linkage)
        constants = link_constants(self._believed(linkage), jnp.zeros(len(q)))
        rows = zip(constants.fixed, qdd_ref, errors)
        demanded = tuple(where(fixed, jnp.zeros_like(b), a + b) for fixed, a, b in rows)
        return required_efforts(constants, tuple(q), tuple(qd), demanded)


def gains_from_frequency(
    linkage: Linkage,
    q: ArrayLike,
    frequency: ArrayLike,
    damping_ratio: ArrayLike,
    forces: Forces = (),
) -> tuple[Float[Array, " joint"], Float[Array, " joint"]]:
    """Computes the gains of PD control for given natural frequencies and damping.

    The gains are kp = frequency^2 M_kk and kd = 2 damping_ratio frequency M_kk, with
    the inertia M_kk that joint k moves at `q` while the others stand still. A joint
    that moves alone, without gravity, springs or dampers, then has this frequency and
    damping; for all joints together see `closed_loop_modes`. Gains of `ComputedTorque`
    are frequency^2 and 2 damping_ratio frequency.

    **Arguments:**

    - `linkage`, `q`: the arm and its joint positions [m or rad].
    - `frequency` [rad/s], positive, and `damping_ratio`, not negative: one per joint or
      one for all.
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
