"""Sums of squares of simulated residuals, and checks of what is simulated."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from ..base.checks import instance
from ..forces.element import elements
from ..linkage.coordinates import real_state
from ..linkage.linkage import check_linkage
from ..simulation.scene import Scene
from ..simulation.sensitivities import Sensitivities
from ..simulation.simulate import check_elements
from .methods import Evaluation


def check_scene(name: str, scene: Any, ts: Array) -> None:
    """Raises ValueError unless `scene` can be simulated over the times `ts`."""
    instance(name, scene, Scene)
    check_linkage(scene.linkage)
    real_state(f"{name}.state0", scene.state0, scene.linkage)
    elements(f"{name}.forces", scene.forces)
    check_elements(scene.forces, scene.linkage, ts)


def sum_of_squares(found: Sensitivities, **facts: Any) -> Evaluation:
    """The sum of squared residuals, its gradient and Gauss-Newton's curvature."""
    value, jacobian, *_ = found
    loss, curvature = jnp.sum(value**2), 2 * jacobian.T @ jacobian
    return Evaluation(loss, 2 * jacobian.T @ value, curvature, facts)
