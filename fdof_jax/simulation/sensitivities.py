"""Integrates a motion together with its derivatives in a few parameters.

The derivatives obey the variational equations, under the same error control as the
motion. Differentiation through the integrator would take twice as long to compile.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import Array

from ..forces.element import elements
from ..xla.callbacks import without_checks
from .field import args_of, initial_own, own_states, whole
from .prescribed import motion_at, start_of, term_of
from .scene import Scene
from .solution import Solution
from .step_wrappers import landing_on
from .steps import adaptive

# Tolerance of the motion and its derivatives, whichever are larger. The steps that the
# derivatives need make the loss on Fig 7's circle right to 1e-8.
TOLERANCE = 1e-5


class Sensitivities(NamedTuple):
    """Residuals (m,) and their Jacobian (m, n), with the scene and its motion."""

    residuals: Array
    jacobian: Array
    scene: Scene
    solution: Solution


def _largest(state: Array) -> Array:
    """Returns the largest rms among the motion and its derivatives."""
    return jnp.sqrt(jnp.max(jnp.mean(state**2, axis=1)))


def sensitivities(
    scene_at: Callable[[Array], Scene],
    residuals: Callable[[Scene, Solution], Array],
    z: Array,
    ts: Array,
    tolerance: float = TOLERANCE,
) -> Sensitivities:
    """Computes residuals of a simulated scene and their Jacobian in `z` (n,).

    The function is pure. A motion that fails is NaN from then on.

    **Arguments:** `scene_at`: maps the parameters `z` to a scene; `residuals`: maps the
    scene and its motion at the times `ts` to an array; `tolerance`: relative and
    absolute tolerance of each step in float64.
    """

    def motion_of(z):
        scene = scene_at(z)
        q0, qd0 = (jnp.asarray(a, dtype=float) for a in scene.state0)
        args = args_of(scene.linkage, q0, elements("scene.forces", scene.forces))
        return args, whole(*start_of(args, qd0), initial_own(args))

    # One array, with the motion as first row and the derivatives below, gives the
    # integrator fewer and larger operations.
    start, along = jax.linearize(
        lambda z: jnp.stack(jax.tree.leaves(motion_of(z)[1])), z
    )
    structure = jax.tree.structure(motion_of(z)[1])
    directions = jnp.eye(z.size, dtype=z.dtype)

    @jax.jit  # traced once, not at each use by the solver
    def field(t, state, z):
        def rates(row, z):
            args, _ = motion_of(z)
            y = jax.tree.unflatten(structure, tuple(row))
            rates = term_of(args.forces).vf(t, y, args)
            return jnp.stack(jax.tree.leaves(rates))

        value, along = jax.linearize(rates, state[0], z)
        return jnp.concatenate([value[None], jax.vmap(along)(state[1:], directions)])

    def observed(z, t, row):
        args, _ = motion_of(z)
        y = jax.tree.unflatten(structure, tuple(row))
        return *motion_at(args, t, y), own_states(args, y)

    controller = adaptive(tolerance, max(tolerance, TOLERANCE))
    controller = dataclasses.replace(controller, norm=_largest)
    controller = landing_on(controller, motion_of(z)[0].forces, ts.dtype)
    with without_checks():
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(field),  # pyright: ignore[reportArgumentType]
            # A method of few stages, because much of the work lies outside of them.
            diffrax.Tsit5(),
            t0=ts[0],
            t1=ts[-1],
            dt0=1e-3,
            y0=jnp.concatenate([start[None], jax.vmap(along)(directions)]),
            args=z,
            saveat=diffrax.SaveAt(ts=ts),
            stepsize_controller=controller,
            adjoint=diffrax.ForwardMode(),
            max_steps=65536,
            throw=False,
        )
    assert found.ys is not None  # because of saveat
    # diffrax leaves infinity at times that it did not reach.
    states = jnp.where(jnp.isinf(found.ys), jnp.nan, found.ys)

    def judged(z, rows):
        scene = scene_at(z)
        q, qd, own = jax.vmap(observed, in_axes=(None, 0, 0))(z, ts, rows)
        solution = Solution(ts, q, qd, found.stats, found.result, own)
        return residuals(scene, solution), (scene, solution)

    value, change, (scene, solution) = jax.linearize(
        judged, z, states[:, 0], has_aux=True
    )
    slopes = jnp.moveaxis(states[:, 1:], 1, 0)
    jacobian = jax.vmap(change, out_axes=1)(directions, slopes)
    return Sensitivities(value, jacobian, scene, solution)
