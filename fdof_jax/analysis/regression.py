"""Inertial parameters, and the regressor of the inverse dynamics."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ..dynamics import inverse_dynamics
from ..linkage.linkage import Linkage, check_linkage, compiled


def inertial_parameters(linkage: Linkage) -> Float[Array, "link 4"]:
    """Mass [kg], moments m p, m q [kg m] and inertia [kg m^2] of each link.

    The inertia is about the characteristic point of the link. The dynamics are linear
    in these parameters: see `regressor`.

    **Raises:** ValueError if `linkage` is not a linkage.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig3().linkage
    >>> p = fj.analysis.inertial_parameters(arm)
    >>> p[0].tolist()  # m, m p, m q, I about the pivot
    [5.0, 2.5, -5.0, 6.25]
    """
    check_linkage(linkage)
    m, (p, q) = linkage.mass, linkage.com.T
    return jnp.stack([m, m * p, m * q, linkage.inertia + m * (p**2 + q**2)], axis=1)


@compiled("q", "qd", "qdd")
def regressor(
    linkage: Linkage,
    q: Float[Array, " joint"],
    qd: Float[Array, " joint"],
    qdd: Float[Array, " joint"],
) -> Float[Array, "joint link 4"]:
    """Coefficients of the inertial parameters in the inverse dynamics.

    The efforts are tau = regressor : `inertial_parameters(linkage)`, summed over links
    and parameters. The regressor itself does not depend on the linkage's masses and
    inertias.

    The rank of regressors stacked over a motion is the number of combinations of
    parameters that can be identified: nine of the twelve for an RPR arm.

    **Arguments:** `linkage`; `q`, `qd`, `qdd`: joint positions, velocities and
    accelerations (n,) [m or rad, and per s and s^2].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> arm = fj.scenes.fig5().linkage
    >>> import numpy as np
    >>> state = [0.1, 0.2, 0.3], [1, 0, -1], [0.5, 0.5, 0.5]
    >>> p = fj.analysis.inertial_parameters(arm)
    >>> np.tensordot(fj.analysis.regressor(arm, *state), p, 2).tolist()
    [68.982, 35.32, 11.766]
    >>> fj.inverse_dynamics(arm, *state).tolist()
    [68.982, 35.32, 11.766]
    """

    def efforts(parameters):
        mass, moments, inertia = jnp.split(parameters, [1, 3], axis=1)
        com = moments / mass
        about_center = inertia[:, 0] - mass[:, 0] * jnp.sum(com**2, axis=1)
        arm = eqx.tree_at(
            lambda arm: (arm.mass, arm.com, arm.inertia),
            linkage,
            (mass[:, 0], com, about_center),
        )
        return inverse_dynamics(arm, q, qd, qdd)

    # The efforts are linear in the parameters, so any values serve.
    return jax.jacfwd(efforts)(jnp.tile(jnp.array([1.0, 0.0, 0.0, 1.0]), (q.size, 1)))
