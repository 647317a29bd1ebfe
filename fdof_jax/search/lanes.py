"""One compiled evaluation for many runs, each of one scene or several."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from ..base.checks import instance
from ..base.configuration import options_of_loops
from ..base.functions import sharing_functions
from ..forces.element import elements
from ..linkage.coordinates import real_state
from ..linkage.linkage import check_linkage
from ..simulation.scene import Scene, stacked
from ..simulation.sensitivities import Sensitivities
from ..simulation.simulate import elements_at_door, simulate
from .bounded import Evaluation

# Greatest number of lanes in a compiled batch: fewer do not fill the processor, and
# more wait for each other.
_LANES = 8

Evaluate = Callable[[Array, Any], Evaluation]  # (z, problem) of one lane


def check_scene(name: str, scene: Scene) -> None:
    """Raises ValueError for shapes and kinds with which nothing can be simulated."""
    instance(name, scene, Scene)
    check_linkage(scene.linkage)
    real_state(f"{name}.state0", scene.state0, scene.linkage)
    elements(f"{name}.forces", scene.forces)
    elements_at_door(scene.linkage, scene.forces)


def check_motion(name: str, scene: Scene, ts: ArrayLike) -> None:
    """Raises ValueError with the reason if a scene cannot be simulated over `ts`.

    Searches call it after a failure, as a check beforehand would have to compile.
    """
    try:
        simulate(scene.linkage, scene.state0, ts, scene.forces)
    except RuntimeError as error:
        message = f"{name}: expected one that can be simulated from its start. {error}"
        raise ValueError(message) from error


def sum_of_squares(found: Sensitivities, **facts: Array) -> Evaluation:
    """The sum of squared residuals, its gradient and Gauss-Newton's curvature."""
    value, jacobian, *_ = found
    loss, curvature = jnp.sum(value**2), 2 * jacobian.T @ jacobian
    return Evaluation(loss, 2 * jacobian.T @ value, curvature, facts)


@eqx.filter_jit(compiler_options=options_of_loops())  # pyright: ignore[reportCallIssue]
def _evaluate(
    evaluate: Evaluate, z: Array, moving: PyTree, shared: PyTree
) -> Evaluation:
    """Evaluates lanes, along the leading axis of `z` and `moving`."""

    def lane(z, moving):
        return evaluate(z, eqx.combine(moving, shared))

    if len(z) > 1:
        return jax.vmap(lane)(z, moving)
    # A single lane is compiled without a batch, which is faster.
    one = lane(*jax.tree.map(lambda a: a[0], (z, moving)))
    return jax.tree.map(lambda a: a[None], one)


def _moves(leaf: object) -> bool:
    """Returns whether an array with leading axes (run, member) differs along them."""
    return isinstance(leaf, np.ndarray) and bool((leaf != leaf[:1, :1]).any())


class Lanes:
    """Evaluates runs by one compiled program, in groups of lanes."""

    def __init__(
        self,
        evaluate: Evaluate,
        problems: list[list[PyTree]],
        starts: int = 1,
        order: int = 1,
    ):
        """`problems`: rows of equally many members, for as many runs as `starts` each;
        `order`: order of the power mean over the members.
        """
        self.evaluate, self.order = evaluate, order
        every = stacked([stacked(members) for members in problems])
        # Values common to all lanes are not batched, so XLA computes with them once.
        moving, shared = eqx.partition(every, _moves)
        self.shared = jax.tree.map(
            lambda a: jnp.asarray(a[0, 0]) if isinstance(a, np.ndarray) else a, shared
        )
        self.moving = jax.tree.map(lambda a: np.repeat(a, starts, axis=0), moving)
        self.members = len(problems[0])
        lanes = len(problems) * starts * self.members
        self.size = -(-lanes // -(-lanes // _LANES))

    def __call__(self, z: np.ndarray, runs: np.ndarray) -> Evaluation:
        points = np.repeat(z, self.members, axis=0)
        run = np.repeat(runs, self.members)
        member = np.tile(np.arange(self.members), len(runs))

        def evaluated(lanes: np.ndarray) -> Evaluation:
            there = run[lanes], member[lanes]
            moving = jax.tree.map(lambda a: jnp.asarray(a[there]), self.moving)
            here = jnp.asarray(points[lanes])
            evaluate = lambda shared: _evaluate(self.evaluate, here, moving, shared)
            found = sharing_functions(evaluate, problem=self.shared)
            return jax.tree.map(np.asarray, found)

        # Copies fill the last group.
        shape = -(-len(run) // self.size), self.size
        groups = map(evaluated, np.resize(np.arange(len(run)), shape))
        rows = jax.tree.map(lambda *a: np.concatenate(a)[: len(run)], *groups)
        shape = len(runs), self.members
        members = jax.tree.map(lambda a: a.reshape(*shape, *a.shape[1:]), rows)
        return power_mean(members, self.order)


def power_mean(members: Evaluation, order: int) -> Evaluation:
    """The power mean over the axis of members, mean(loss^order)^(1/order).

    Its curvature combines the members' curvatures with the exact one of the mean.
    """
    loss, gradient, curvature, facts = members
    largest = np.max(loss, axis=1, keepdims=True)
    part = loss / np.where(largest > 0, largest, 1)
    mean = np.mean(part**order, axis=1, keepdims=True) ** (1 / order)
    # The weight (loss / mean)^(order - 1) / members; loss and mean vanish together.
    weight = (part / np.where(mean > 0, mean, 1)) ** (order - 1) / loss.shape[1]
    total = np.einsum("rm,rmn->rn", weight, gradient)
    bent = np.einsum("rm,rmij->rij", weight, curvature)
    whole = mean * largest
    if order > 1:
        value = np.where(loss > 0, loss, 1)
        spread = np.einsum("rm,rmi,rmj->rij", weight / value, gradient, gradient)
        outer = total[:, :, None] * total[:, None, :]
        spread -= outer / np.where(whole > 0, whole, 1)[:, :, None]
        bent = bent + (order - 1) * spread
    return Evaluation(whole[:, 0], total, bent, facts | {"member_loss": loss})
