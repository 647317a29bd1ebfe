"""Converts a scene to a term of diffrax, for your own solve."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import Array

from ..base.checks import instance, refusal
from ..forces.element import elements_on
from ..forces.holders import check_free
from ..linkage.coordinates import real_state
from ..linkage.linkage import check_linkage, without_fixed
from .holding import changes
from .prescribed import prescribed
from .scene import Scene
from .until import conditions_in
from .vector_field import Args, args_of, initial_own, schedule_of, vector_field, whole

_Y = tuple[Array, Array, Array]  # positions, velocities, states of elements


def ode_term(scene: Scene) -> tuple[diffrax.ODETerm, _Y, Args]:
    """Returns a scene as the term, start and arguments of a `diffrax.diffeqsolve`.

    `diffrax.diffeqsolve(term, solver, 0, t1, dt0, y0, args)` offers dense solutions,
    diffrax's events, and noise by a `MultiTerm` (see the recipes). Unlike `simulate`,
    it does not end steps where elements jump or switch, so derivatives there may be
    wrong. Rounding errors may shorten its steps, and no result reports a singular arm.

    **Returns:** `(term, y0, args)`. `y0` is `(q, qd, own)`: positions (n,) [m or rad],
    velocities (n,), and the elements' own states in one array (m,).
    `term.vf(t, y, args)` returns its rates.

    **Raises:** ValueError for malformed scenes, and for elements that hold joints, a
    `Payload` with a `begin`, a `PrescribedMotion`, a `Reset` and an `Until`.

    >>> import diffrax
    >>> import fdof_jax as fj
    >>> term, y0, args = fj.simulation.ode_term(fj.scenes.fig5())
    >>> control = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    >>> solve = diffrax.diffeqsolve(
    ...     term, diffrax.Dopri8(), 0, 1.0, 1e-3, y0, args, stepsize_controller=control)
    >>> q, qd, own = solve.ys
    >>> q[-1].tolist()
    [-1.713, -0.0219, -0.696]
    """
    instance("scene", scene, Scene)
    check_linkage(scene.linkage)
    linkage, state0, *_ = scene
    forces = elements_on(linkage, scene.forces)
    start = real_state("scene.state0", state0, linkage)
    for index, element in enumerate(forces):
        check_free(name := f"scene.forces[{index}]", element)
        alone = (element,)
        if prescribed(alone) or changes(alone) or conditions_in(alone):
            expected = "no PrescribedMotion, Reset, Until or Payload with a begin"
            raise refusal(name, f"{expected}, as only simulate has them", element)
    q, qd = (without_fixed(linkage, jnp.asarray(value)) for value in start)
    args = args_of(linkage, q, forces)
    y0 = q, qd, jnp.array(initial_own(args), q.dtype)
    eqx.filter_eval_shape(_rates, 0.0, y0, args)  # refuses efforts of other shapes
    return _TERM, y0, args


def _rates(t: Any, y: _Y, args: Args) -> _Y:
    q, qd, own = y
    state = whole(tuple(q - args.q0), tuple(qd), tuple(own))
    rates = *vector_field(t, state, args, schedule_of(t, args)), ()
    of_q, of_qd, of_own, *_ = rates
    return jnp.stack(of_q), jnp.stack(of_qd), jnp.array(of_own, q.dtype)


_TERM = diffrax.ODETerm(_rates)
