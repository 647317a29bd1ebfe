"""What force elements that move masses add to the equations of motion."""

import jax
import jax.numpy as jnp
from jax import Array

from .forces import Forces, InertialElement
from .linkage import Linkage
from .rates import Added
from .validation import callable_tuple


def inertial(forces: Forces) -> Forces:
    """Those of the elements that move masses, refused unless it is such a tuple."""
    callable_tuple("forces", forces)
    return tuple(e for e in forces if isinstance(e, InertialElement))


def energetic(forces: Forces) -> Forces:
    """Those of the elements that have energy: springs too."""
    callable_tuple("forces", forces)
    return tuple(e for e in forces if hasattr(e, "potential_energy"))


def added_energy(
    linkage: Linkage, forces: Forces, q: Array, qd: Array
) -> tuple[Array, Array]:
    """Kinetic and potential energy of the elements [J]."""
    kinetic, potential = jnp.zeros(()), jnp.zeros(())
    for element in energetic(forces):
        potential = potential + element.potential_energy(q, linkage)
        if isinstance(element, InertialElement):
            kinetic = kinetic + element.kinetic_energy(q, qd, linkage)
    return kinetic, potential


def added_inertia(
    linkage: Linkage, forces: Forces, q: Array, qd: Array
) -> tuple[Added, Array] | None:
    """The elements' share of the mass matrix and of the bias (3,), if they have one.

    By Lagrange's equations: the derivative of the momenta along the motion, less that
    of the energies in the positions.
    """
    if not inertial(forces):
        return None

    def momenta(q: Array, qd: Array) -> Array:
        kinetic = lambda qd: added_energy(linkage, forces, q, qd)[0]
        return jax.grad(kinetic)(qd)

    def lagrangian(q: Array) -> Array:
        kinetic, potential = added_energy(linkage, forces, q, qd)
        return kinetic - potential

    matrix = jax.jacfwd(momenta, 1)(q, qd)
    _, along = jax.jvp(lambda q: momenta(q, qd), (q,), (qd,))
    upper = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    m11, m12, m13, m22, m23, m33 = (matrix[place] for place in upper)
    return (m11, m12, m13, m22, m23, m33), along - jax.grad(lagrangian)(q)
