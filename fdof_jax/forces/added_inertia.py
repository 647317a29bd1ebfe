"""Terms that force elements with masses add to the equations of motion."""

from functools import reduce
from operator import add

import jax
import jax.numpy as jnp
from jax import Array

from ..linkage.linkage import Linkage
from ..mechanics.equations import Upper
from .element import Element, Forces, InertialElement, elements


def inertial(forces: Forces) -> tuple[InertialElement, ...]:
    """Checks the tuple of elements and returns those that move masses."""
    found = elements("forces", forces)
    return tuple(e for e in found if isinstance(e, InertialElement))


def energetic(forces: Forces) -> tuple[Element, ...]:
    """Checks the tuple of elements and returns those with energy, springs included."""
    found = elements("forces", forces)
    return tuple(e for e in found if e.potential_energy is not None)


def added_energy(
    linkage: Linkage, forces: Forces, q: Array, qd: Array
) -> tuple[Array, Array]:
    """Computes the kinetic and the potential energy of the elements [J]."""
    kinetic, potential = jnp.zeros(()), jnp.zeros(())
    for element in energetic(forces):
        potential = potential + element.potential_energy(q, linkage)
        if isinstance(element, InertialElement):
            coordinates = lambda q, e=element: e.coordinates(q, linkage)
            _, rates = jax.jvp(coordinates, (q,), (qd,))
            kinetic = kinetic + jnp.sum(element.weights(linkage) * rates**2) / 2
    return kinetic, potential


def added_inertia(
    linkage: Linkage, forces: Forces, q: Array, qd: Array
) -> tuple[Upper, Array] | None:
    """Computes what elements add to the mass matrix and the bias (3,), if anything.

    M = J^T W J and bias = J^T W (dJ/dt) qd + dV/dq, where J is the derivative of the
    coordinates. Forward mode alone keeps the code of further derivatives small.
    """
    if not inertial(forces):
        return None
    matrices, biases = [], []
    for element in inertial(forces):
        coordinates = lambda q, e=element: e.coordinates(q, linkage)
        along = lambda q, c=coordinates: jax.jvp(c, (q,), (qd,))[1]
        _, turning = jax.jvp(along, (q,), (qd,))
        jacobian, weights = jax.jacfwd(coordinates)(q), element.weights(linkage)
        weighted = weights[:, None] * jacobian
        matrices.append(jnp.sum(weighted[:, :, None] * jacobian[:, None, :], axis=0))
        slope = jax.jacfwd(lambda q, e=element: e.potential_energy(q, linkage))(q)
        biases.append(jnp.sum(weighted * turning[:, None], axis=0) + slope)
    matrix, bias = (reduce(add, rows) for rows in (matrices, biases))
    upper = tuple(tuple(row[k:]) for k, row in enumerate(matrix))
    return upper, bias
