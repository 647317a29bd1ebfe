"""Inertial parameters, and the regressor of the inverse dynamics."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ..linkage.frames import dot, frames
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
    inertias. It is computed by Lagrange's equations for one parameter at a time.

    The rank of regressors stacked over a motion is the number of combinations of
    parameters that can be identified: nine of the twelve for an RPR arm.

    **Arguments:** `linkage`; `q`, `qd`, `qdd`: joint positions, velocities and
    accelerations (3,) [m or rad, and per s and s^2].

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

    def parts(q):
        start, direction, *_ = frames(linkage, q)
        return start[1:], direction[1:]

    def lagrangians(q, qd):
        """Lagrangians of unit parameters, (3, 4)."""
        (start, along), (velocity, turning) = jax.jvp(parts, (q,), (qd,))
        # d(direction)/dt = i * rate * direction.
        rate = jnp.imag(turning * jnp.conj(along))
        g = linkage.gravity
        return jnp.stack(
            [
                dot(velocity, velocity) / 2 - g * start.imag,
                dot(velocity, turning) - g * along.imag,
                dot(velocity, 1j * turning) - g * (1j * along).imag,
                rate**2 / 2,
            ],
            axis=1,
        )

    momenta = lambda q, qd: jax.jacfwd(lagrangians, argnums=1)(q, qd)
    _, change = jax.jvp(momenta, (q, qd), (qd, qdd))
    slopes = jax.jacfwd(lagrangians, argnums=0)(q, qd)
    return jnp.moveaxis(change - slopes, -1, 0)
