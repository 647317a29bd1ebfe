"""One compiled evaluation for many runs, each of one problem or several."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..simulation.scene import stacked
from .methods import Evaluation

# Greatest number of lanes in a compiled batch: fewer do not fill the processor, and
# more wait for each other.
_LANES = 8

Evaluate = Callable[[Array, Any], Evaluation]  # (z, problem) of one lane


@eqx.filter_jit
def _evaluate(evaluate: Evaluate, z: Array, moving: Any, shared: Any) -> Evaluation:
    """Evaluates one lane, or several if `z` and `moving` have a leading axis."""

    def lane(z, moving):
        return evaluate(z, eqx.combine(moving, shared))

    return lane(z, moving) if z.ndim == 1 else jax.vmap(lane)(z, moving)


def _moves(leaf: Any) -> bool:
    """Returns whether an array with leading axes (run, member) differs along them."""
    return isinstance(leaf, np.ndarray) and bool((leaf != leaf[:1, :1]).any())


class Lanes:
    """Evaluates runs by one compiled program, in groups of lanes with similar work.

    Work is measured by `steps`, which the facts of an evaluation must include.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        problems: list[list[Any]],
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
        leaves, self.structure = jax.tree.flatten(moving)
        self.leaves = [np.repeat(leaf, starts, axis=0) for leaf in leaves]
        self.members = len(problems[0])
        self.steps = np.zeros((len(problems) * starts, self.members), int)
        groups = -(-self.steps.size // _LANES)
        self.size = -(-self.steps.size // groups)

    def __call__(self, z: np.ndarray, runs: np.ndarray) -> Evaluation:
        lanes = [(run, member) for run in runs for member in range(self.members)]
        rows = np.repeat(z, self.members, axis=0)
        if self.size == 1:
            groups: Any = [np.array(0)]
        else:
            work = np.argsort([-self.steps[lane] for lane in lanes], kind="stable")
            # Copies fill the last group.
            groups = np.resize(work, (-(-len(lanes) // self.size), self.size))
        found: list[Any] = [None] * len(lanes)
        for group in groups:
            run, member = np.moveaxis(np.array(lanes)[group], -1, 0)
            arrays = [jnp.asarray(leaf[run, member]) for leaf in self.leaves]
            moving = jax.tree.unflatten(self.structure, arrays)
            at = jnp.asarray(rows[group])
            values = _evaluate(self.evaluate, at, moving, self.shared)
            values = jax.tree.map(np.asarray, values)
            for place, lane in enumerate(np.atleast_1d(group)):
                found[lane] = values.row(place) if group.ndim else values
        for lane, values in zip(lanes, found):
            self.steps[lane] = values.facts["steps"]
        shape = len(runs), self.members
        by_run = jax.tree.map(
            lambda *a: np.stack(a).reshape(*shape, *a[0].shape), *found
        )
        return power_mean(by_run, self.order)


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
    if order > 1:
        value = np.where(loss > 0, loss, 1)
        spread = np.einsum("rm,rmi,rmj->rij", weight / value, gradient, gradient)
        whole = (mean * largest)[:, :, None]
        spread -= total[:, :, None] * total[:, None, :] / np.where(whole > 0, whole, 1)
        bent = bent + (order - 1) * spread
    return Evaluation(
        (mean * largest)[:, 0],
        total,
        bent,
        facts | {"member_loss": loss},
    )
