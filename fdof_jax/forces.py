"""Force elements: what acts on the joints besides gravity.

An element is any pytree called as `(t, q, qd, linkage) -> tau`, with joint positions,
velocities and efforts of shape (3,). A scene's elements are a tuple; their efforts
add up. The PD controller is one too: see `control`.
"""

import equinox as eqx
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .linkage import Linkage
from .validation import real_array


class JointDamper(eqx.Module):
    """Viscous damping of the real joints, as in Fig 3: -coefficient * qd.

    On the relative rate of a revolute joint, with the reaction on the preceding link.

    **Arguments:** `coefficient`: one for all joints or one per joint, not negative
    [N s/m or N m s/rad].

    **Raises:** ValueError for malformed or negative coefficients.
    """

    coefficient: Float[Array, " joint"]

    def __init__(self, coefficient: ArrayLike):
        self.coefficient = real_array(
            "coefficient", coefficient, (3,), minimum=0, broadcast=True
        )

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        return -self.coefficient * qd


class JointEffort(eqx.Module):
    """Constant joint efforts, the paper's F and T inputs.

    **Arguments:** `tau`: one per joint [N or N m].

    **Raises:** ValueError for malformed efforts.
    """

    tau: Float[Array, " joint"]

    def __init__(self, tau: ArrayLike):
        self.tau = real_array("tau", tau, (3,))

    def __call__(self, t: Array, q: Array, qd: Array, linkage: Linkage) -> Array:
        return self.tau
