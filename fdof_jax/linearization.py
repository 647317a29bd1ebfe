"""Linear analysis for control: A and B, equilibria, holding efforts, the regressor."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from .dynamics import forward_dynamics, inverse_dynamics
from .forces import Forces, StatefulElement
from .linkage import Linkage, State, check_linkage, real_state
from .points import dot, frames_of
from .validation import callable_tuple, real_array


class Linearization(NamedTuple):
    """d(q, qd)/dt = A (q, qd) + B tau, about a state: (6, 6) and (6, 3)."""

    A: Float[Array, "6 6"]
    B: Float[Array, "6 joint"]


def _accelerations(
    linkage: Linkage, forces: Forces, q: Array, qd: Array, tau: Array, t: Array
) -> Array:
    for element in forces:
        tau = tau + element(t, q, qd, linkage)
    return forward_dynamics(linkage, q, qd, tau, forces)


def _without_states(forces: Forces) -> None:
    callable_tuple("forces", forces)
    if any(isinstance(element, StatefulElement) for element in forces):
        raise ValueError(
            f"forces: expected elements without a state of their own, got {forces!r}."
        )


def linearize(
    linkage: Linkage, forces: Forces, state: State, t: ArrayLike = 0.0
) -> Linearization:
    """The equations of motion to first order about a state, at a time.

    **Arguments:** the linkage; force elements without a state of their own; `state`:
    joint positions and velocities; `t`: the time that the elements are given [s].

    **Returns:** `A` and `B` of d(q, qd)/dt = A (q, qd) + B tau, for small changes; tau
    are efforts in the joints besides those of the forces [N or N m].

    **Raises:** ValueError for malformed arguments.
    """
    check_linkage(linkage)
    _without_states(forces)
    q, qd = real_state("state", state)
    t = real_array("t", t, ())

    def rates(q, qd, tau):
        return jnp.concatenate([qd, _accelerations(linkage, forces, q, qd, tau, t)])

    by_q, by_qd, by_tau = jax.jacfwd(rates, argnums=(0, 1, 2))(q, qd, jnp.zeros(3))
    return Linearization(jnp.concatenate([by_q, by_qd], axis=1), by_tau)


def equilibrium(
    linkage: Linkage, forces: Forces, q: ArrayLike, t: ArrayLike = 0.0
) -> Float[Array, " joint"]:
    """Joint positions near `q` at which the arm stays at rest under its forces.

    **Arguments:** the linkage; force elements without a state of their own; `q`: a
    first guess [m or rad]; `t`: the time that the elements are given [s].

    **Returns:** positions (3,); NaN where Levenberg and Marquardt's method finds none.

    **Raises:** ValueError for malformed arguments.
    """
    check_linkage(linkage)
    _without_states(forces)
    q, t = real_array("q", q, (3,)), real_array("t", t, ())
    still = jnp.zeros(3)

    def efforts(q, _):
        total = -inverse_dynamics(linkage, q, still, still, forces)
        for element in forces:
            total = total + element(t, q, still, linkage)
        return total

    tight = 1e3 * jnp.finfo(q.dtype).eps
    solver = optimistix.LevenbergMarquardt(rtol=tight, atol=tight)
    found = optimistix.root_find(efforts, solver, q, throw=False)
    good = found.result == optimistix.RESULTS.successful
    return jnp.where(good, found.value, jnp.nan)


def holding_efforts(
    linkage: Linkage, q: ArrayLike, forces: Forces = ()
) -> Float[Array, " joint"]:
    """The joint efforts that hold the arm at rest against gravity [N or N m].

    **Arguments:** the linkage; `q`: joint positions [m or rad]; `forces`: elements
    whose masses are held too.

    **Raises:** ValueError for malformed arguments.
    """
    still = jnp.zeros(3)
    return inverse_dynamics(linkage, q, still, still, forces)


def inertial_parameters(linkage: Linkage) -> Float[Array, "link 4"]:
    """Per link: mass [kg], its moments m p, m q [kg m], and inertia about the start.

    In these the dynamics are linear: see `regressor`. The inertia [kg m^2] is about the
    characteristic point of the link.
    """
    m, (p, q) = linkage.mass, linkage.com.T
    return jnp.stack([m, m * p, m * q, linkage.inertia + m * (p**2 + q**2)], axis=1)


def regressor(
    linkage: Linkage, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike
) -> Float[Array, "joint link 4"]:
    """What multiplies the inertial parameters in the inverse dynamics.

    tau = regressor : `inertial_parameters(linkage)`, summed over links and parameters;
    the masses of the linkage do not count. By Lagrange's equations for one parameter at
    a time.

    **Arguments:** the linkage; `q`, `qd`, `qdd`: joint positions, velocities and
    accelerations (3,) [m or rad, and per s and s^2].

    **Raises:** ValueError for malformed arguments.
    """
    check_linkage(linkage)
    q, qd, qdd = (
        real_array(name, value, (3,))
        for name, value in (("q", q), ("qd", qd), ("qdd", qdd))
    )

    def parts(q):
        frames = frames_of(linkage, tuple(q))
        start, direction = (jnp.stack(rows[1:]) for rows in frames[:2])
        return start, direction

    def lagrangians(q, qd):
        """Of unit parameters, (3, 4)."""
        (start, along), (velocity, turning) = jax.jvp(parts, (q,), (qd,))
        # d(direction)/dt = i rate direction.
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
