"""Recordings of a motion: what is seen, and which samples are missing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from ..base.checks import instance, real_array, shown
from ..mechanics.kinematics import joint_positions, tip_position
from ..simulation.sampled import check_joints
from ..simulation.scene import Scene
from ..simulation.solution import Solution


def link_ends(scene: Scene, solution: Solution) -> Float[Array, "time link 2"]:
    """Positions of markers at the ends of the links: the next joints, and the tip.

    **Arguments:** `scene`; `solution`: its motion.

    **Returns:** points (x, y) from the ground pivot [m].

    **Raises:** ValueError for malformed arguments.

    >>> import fdof_jax as fj
    >>> import numpy as np
    >>> arm, start, *_ = fj.scenes.fig5()
    >>> motion = fj.simulate(arm, start, np.linspace(0, 1, 101))
    >>> fj.identification.link_ends(fj.scenes.fig5(), motion)[0].tolist()
    [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]
    """

    instance("scene", scene, Scene)
    instance("solution", solution, Solution)
    check_joints("solution", solution, scene.linkage)

    def ends(q):
        tip = tip_position(scene.linkage, q)
        return jnp.concatenate([joint_positions(scene.linkage, q)[1:], tip[None]])

    return jax.vmap(ends)(solution.q)


def observations(
    name: str, observed: Any, noise: Any, ts: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Readings (recording, time, ...), 0 where missing, and their weights."""
    try:
        readings = np.asarray(observed, dtype=jnp.result_type(float))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name}: expected an array of real numbers, got {shown(observed)}."
        ) from error
    if np.isinf(readings).any():
        raise ValueError(f"{name}: expected finite readings (or NaN), got infinity.")
    spread = np.ones(()) if noise is None else noise
    spread = np.asarray(real_array("noise", spread, np.shape(spread), above=0))
    try:
        weights = np.broadcast_to(1 / spread, readings.shape[1:])
    except ValueError:
        raise ValueError(
            "noise: expected one number, or an array that broadcasts to a recording, "
            f"{readings.shape[1:]}, got shape {spread.shape}."
        ) from None
    if readings.shape[1:2] != ts.shape:
        raise ValueError(
            f"{name}: expected a row for each of the {ts.size} times, got shape "
            f"{readings.shape[1:]}."
        )
    there = ~np.isnan(readings)
    return np.where(there, readings, 0), np.where(there, weights, 0)
