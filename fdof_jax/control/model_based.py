"""Controllers with a model of the arm: gravity feedforward and computed torque."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from ..base.checks import real_array
from ..linkage.fields import Condition, Truth
from ..linkage.frames import scalar_frames
from ..linkage.linkage import Linkage, check_linkage, possible
from ..mechanics.equations import Scalars, link_constants
from ..mechanics.rates import required_efforts
from ..references.reference import reference_motion
from .pd import PDController


class ModelBased(PDController):
    """A PD controller with a model of the arm."""

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

    The effort of a `PDController` and the effort that holds the arm at rest at its
    actual position (not at the reference) are added and clipped to +-limit as a whole.
    Plain PD control sags under gravity, in Fig 7 by a quarter of a metre.

    **Arguments:**

    - `kp`, `kd`, `limit`, `reference`: as in `PDController` [N/m or N m/rad, N s/m or
      N m s/rad, N or N m].
    - `model`: the controller's model of the arm; None: the arm itself. It does not
      include masses of other force elements, for instance of a load.

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
        arm = jnp.where(
            revolute[k], moment - mass * start[k + 1].real, mass * direction[k].real
        )
        efforts.append(linkage.gravity * arm)
    return tuple(reversed(efforts))


class ComputedTorque(ModelBased):
    """Computed-torque control, by the inverse dynamics: a force element.

    The effort is M(q) (qdd_ref + kp e + kd de/dt) + bias(q, qd) with e = q_ref - q,
    clipped to +-limit as a whole. With an exact model and within the limits, the error
    of each joint obeys d2e/dt2 + kd de/dt + kp e = 0.

    The acceleration qdd_ref is the time derivative of the reference's velocities. It
    has no impulse where the velocities jump.

    **Arguments:** one value per joint or one for all.

    - `kp` [1/s^2], `kd` [1/s]: gains from errors to accelerations, not negative.
    - `limit`: largest effort [N or N m], may be infinite.
    - `reference`: as in `PDController`; differentiable in time.
    - `model`: the controller's model of the arm; None: the arm itself. It does not
      include masses of other force elements, for instance of a load, nor their efforts.

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
        demanded = tuple(jnp.where(fixed, 0, a + b) for fixed, a, b in rows)
        return required_efforts(constants, tuple(q), tuple(qd), demanded)
