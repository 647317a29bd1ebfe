"""The problems: single motions and batches, with their reference solutions."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

REFERENCE_TOLERANCE = 1e-13


class Problem(NamedTuple):
    """One motion; with leading axes in `state0` (and `linkage`), a batch."""

    name: str
    linkage: fj.Linkage
    state0: fj.State
    forces: tuple
    ts: np.ndarray

    @property
    def batch(self) -> int | None:
        shape = np.shape(self.state0.q)
        return shape[0] if len(shape) > 1 else None

    @property
    def axes(self) -> tuple | None:
        """Returns the axes of `linkage` and `state0` for `jax.vmap`; None for one."""
        if self.batch is None:
            return None
        return (0 if self.linkage.ef.ndim > 1 else None), 0


def fig5() -> Problem:
    scene = fj.scenes.fig5()
    return Problem("fig5", scene.linkage, scene.state0, (), np.linspace(0, 2, 21))


def random_linkage(topology: str, rng: np.random.Generator) -> fj.Linkage:
    """Returns a random arm that is regular: every link has inertia of its own."""
    return fj.Linkage(
        topology,
        length=rng.uniform(0, 1.5, 4),
        com=rng.uniform(-1, 1, (3, 2)),
        mass=rng.uniform(0.5, 3, 3),
        inertia=rng.uniform(0.05, 1, 3),
        locked=rng.uniform(-1, 1, 3),
        base_angle=rng.uniform(-3, 3),
        gravity=rng.uniform(0, 10),
    )


def fig5_batch(batch: int) -> Problem:
    """Returns Fig 5's arm from random angles around level, at rest, for 2 s."""
    q = np.random.default_rng(0).uniform(-0.5, 0.5, (batch, 3))
    start = fj.State(q, np.zeros_like(q))
    return Problem("fig5", fj.scenes.fig5().linkage, start, (), np.array([0.0, 2.0]))


def mixed_batch(batch: int) -> Problem:
    """Returns random arms of all topologies, from random states, for 2 s."""
    rng = np.random.default_rng(2)
    arms = [random_linkage(t, rng) for t in rng.choice(fj.TOPOLOGIES, batch)]
    linkage = jax.tree.map(lambda *leaves: jnp.stack(leaves), *arms)
    start = fj.State(*rng.uniform(-1, 1, (2, batch, 3)))
    return Problem("mixed", linkage, start, (), np.array([0.0, 2.0]))


def chain(joints: int, batch: int) -> Problem:
    """Returns chains of equal rods, bent by up to half a radian a joint, for 2 s.

    The rods are as long in all chains, so that their fastest motions are similar.
    """
    linkage = fj.Linkage(
        "R" * joints,
        length=[0.0] + [1.0] * joints,
        com=[[0.5, 0.0]] * joints,
        mass=[1.0] * joints,
        inertia=[1 / 12] * joints,
        base_angle=-np.pi / 2,
    )
    q = np.random.default_rng(joints).uniform(-0.5, 0.5, (batch, joints))
    start = fj.State(q, np.zeros_like(q))
    return Problem(f"{joints} joints", linkage, start, (), np.array([0.0, 2.0]))


def controller(tolerance: Any) -> diffrax.PIDController:
    # An array, so that another tolerance is not another compilation.
    tolerance = jnp.asarray(tolerance, dtype=float)
    smallest = 1e-13 if jax.config.jax_enable_x64 else 1e-8  # ends solves gone NaN
    return diffrax.PIDController(
        rtol=tolerance, atol=tolerance, dtmin=smallest, force_dtmin=False
    )


@eqx.filter_jit
def _reference(linkage, state0, forces, ts, axes):
    def member(linkage, state0):
        return fj.simulate(
            linkage, state0, ts, forces, solver=diffrax.Dopri8(), max_steps=None,
            stepsize_controller=controller(REFERENCE_TOLERANCE),
            adjoint=diffrax.ForwardMode(), throw=False,
        ).q  # fmt: skip

    return jax.vmap(member, axes)(linkage, state0) if axes else member(linkage, state0)


def reference(problem: Problem) -> np.ndarray:
    """Returns joint positions at the output times, at a tolerance of 1e-13."""
    return np.asarray(_reference(*problem[1:], problem.axes))
