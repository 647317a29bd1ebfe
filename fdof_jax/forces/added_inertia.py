"""Terms that force elements with masses add to the equations of motion."""

from functools import reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..base.checks import refusal
from ..linkage.linkage import Linkage
from ..mechanics.equations import Upper
from .element import Element, Forces, InertialElement, elements, elements_on

_ANY = np.zeros(())  # a time: masses that never change are the same at all


def inertial(forces: Forces) -> tuple[InertialElement, ...]:
    """Returns the elements that move masses."""
    return tuple(e for e in forces if isinstance(e, InertialElement))


def present(forces: Forces, t: Array) -> Forces:
    """Returns the elements as they are at a time, for functions without a time.

    **Arguments:** `forces`: a tuple of elements; `t`: time [s].

    **Raises:** ValueError if `forces` is not a tuple of force elements.
    """
    found = elements("forces", forces)
    return tuple(e.at(t) if isinstance(e, InertialElement) else e for e in found)


def _without_times(linkage: Linkage, forces: Forces) -> tuple[Element, ...]:
    """Returns forces as elements; raises ValueError for masses that depend on time."""
    found = elements_on(linkage, forces)
    for index, element in enumerate(found):
        if isinstance(element, InertialElement) and element.at(_ANY) is not element:
            expected = "masses of one time (its `at(t)`), because no time is given"
            raise refusal(f"forces[{index}]", expected, element)
    return found


def inertial_on(linkage: Linkage, forces: Forces) -> tuple[InertialElement, ...]:
    """Checks the tuple of elements and returns those that move masses."""
    return inertial(_without_times(linkage, forces))


def energetic_on(linkage: Linkage, forces: Forces) -> tuple[Element, ...]:
    """Checks the tuple of elements and returns those with energy."""
    parts = _without_times(linkage, forces)
    return tuple(e for e in parts if e.potential_energy is not None)


def added_energy(
    linkage: Linkage, forces: Forces, q: Array, qd: Array
) -> tuple[Array, Array]:
    """Computes the kinetic and the potential energy of `energetic_on` elements [J]."""
    kinetic, potential = jnp.zeros(()), jnp.zeros(())
    for element in forces:
        potential = potential + element.potential_energy(q, linkage)
        if isinstance(element, InertialElement):
            coordinates = lambda q, e=element: e.coordinates(q, linkage)
            _, rates = jax.jvp(coordinates, (q,), (qd,))
            weights = _weights(element, linkage, rates)
            kinetic = kinetic + jnp.sum(weights * rates**2) / 2
    return kinetic, potential


def _weights(element: InertialElement, linkage: Linkage, coordinates: Array) -> Array:
    weights = jnp.asarray(element.weights(linkage))
    if weights.shape != coordinates.shape or weights.ndim != 1:
        raise ValueError(
            f"{type(element).__name__}: expected coordinates and weights of one shape "
            f"(number,), got coordinates of shape {coordinates.shape} and weights of "
            f"shape {weights.shape}."
        )
    return weights


def added_inertia(
    linkage: Linkage, forces: Forces, q: Array, qd: Array
) -> tuple[Upper | None, Array | int]:
    """Computes what elements add to the mass matrix and the bias (n,), or (None, 0).

    M = J^T W J and bias = J^T W (dJ/dt) qd + dV/dq, with the coordinates' Jacobian J.
    """
    if not inertial(forces):
        return None, 0
    # Forward mode alone keeps the code of further derivatives small.
    matrices, biases = [], []
    for element in inertial(forces):
        coordinates = lambda q, e=element: e.coordinates(q, linkage)
        along = lambda q, c=coordinates: jax.jvp(c, (q,), (qd,))[1]
        _, turning = jax.jvp(along, (q,), (qd,))
        jacobian = jax.jacfwd(coordinates)(q)
        weighted = _weights(element, linkage, turning)[:, None] * jacobian
        matrices.append(jnp.sum(weighted[:, :, None] * jacobian[:, None, :], axis=0))
        slope = jax.jacfwd(lambda q, e=element: e.potential_energy(q, linkage))(q)
        biases.append(jnp.sum(weighted * turning[:, None], axis=0) + slope)
    matrix, bias = (reduce(add, rows) for rows in (matrices, biases))
    upper = tuple(tuple(row[k:]) for k, row in enumerate(matrix))
    return upper, bias
