"""Forecasts which members of a batch take long."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from ..dynamics import forward_dynamics
from ..forces.element import elements
from ..linkage.topology import real_joints
from ..simulation.field import element_effort

_STEPS, _ANGLE = 16, 0.3  # of the rough motion: number and size


@eqx.filter_jit
def expected_work(ts: Array, moving: Any, shared: Any) -> Array:
    """Computes for each member a rate [1/s] that grows with its steps.

    It combines the joints' rates and accelerations, in the mean over the beginning of
    the motion, which rough steps find.
    """

    def member(moving):
        linkage, (q, qd), forces = eqx.combine(moving, shared)
        # Revolute joints cause most of the steps, slides hardly any.
        turning = jnp.stack(real_joints(linkage.ef))

        def at(t, q, qd):
            tau = jnp.zeros_like(q)
            for index, element in enumerate(elements("forces", forces)):
                state = element.initial_state(linkage)
                tau = tau + element_effort(index, element, t, q, qd, linkage, state)[0]
            qdd = forward_dynamics(linkage, q, qd, tau, forces)
            rate, acceleration = (jnp.where(turning, a, 0) for a in (qd, qdd))
            norm = jnp.linalg.norm
            return qdd, norm(rate) + jnp.sqrt(norm(acceleration))

        def moved(_, now):
            t, q, qd, total, last = now
            qdd, rate = at(t, q, qd)
            # A motion that these steps lose stays where it was.
            found = jnp.isfinite(rate)
            h = jnp.where(found, step, 0)
            last = jnp.where(found, rate, last)
            qd = qd + h * jnp.where(found, qdd, 0)
            return t + h, q + h * qd, qd, total + last, last

        _, first = at(ts[0], q, qd)
        step = jnp.minimum((ts[-1] - ts[0]) / _STEPS, _ANGLE / first)
        start = ts[0], q, qd, jnp.zeros_like(first), first
        *_, total, _ = jax.lax.fori_loop(0, _STEPS, moved, start)
        return total

    return jax.vmap(member)(moving)
