"""The problems: single motions and batches, with their reference solutions."""

from collections.abc import Iterator
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
    topology: str | None = None  # of all members, None where it varies

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


def _free(name: str, scene: fj.Scene, topology: str, t1: float) -> Problem:
    return Problem(
        name, scene.linkage, scene.state0, (), np.linspace(0, t1, 101), topology
    )


def fig5() -> Problem:
    return _free("fig5", fj.scenes.fig5(), "RRR", 10.0)


def fig7() -> Problem:
    scene = fj.scenes.fig7()
    return _free("fig7", scene, "RPR", scene.t1)._replace(forces=scene.forces)


def swinging_rpr() -> Problem:
    """Returns the arm of Fig 7 without its controller, falling from rest."""
    return _free("rpr-swing", fj.scenes.fig7(), "RPR", 5.0)


def weightless_rrp() -> Problem:
    linkage = fj.Linkage(
        "RRP",
        length=[0, 1, 1, 1],
        com=[[0.5, 0.1], [0.6, 0], [0.3, -0.2]],
        mass=[2, 1, 1],
        inertia=[0.2, 0.1, 0.1],
        locked=[0, 0, 0.5],
        gravity=0,
    )
    state0 = fj.State(np.array([0.3, 0.5, 0.2]), np.array([1.0, -2.0, 0.1]))
    return _free("rrp-zero-g", fj.Scene(linkage, state0, (), 0.0), "RRP", 10.0)


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


def _random_state(rng: np.random.Generator, shape: tuple) -> fj.State:
    return fj.State(rng.uniform(-1, 1, shape), rng.uniform(-1, 1, shape))


def random_singles(per_topology: int = 3) -> Iterator[Problem]:
    rng = np.random.default_rng(1)
    for topology in fj.TOPOLOGIES:
        for k in range(per_topology):
            linkage = random_linkage(topology, rng)
            scene = fj.Scene(linkage, _random_state(rng, (3,)), (), 0.0)
            yield _free(f"random-{topology}-{k + 1}", scene, topology, 2.0)


def fig5_batch(batch: int, half_width: float = 0.5) -> Problem:
    """Returns Fig 5's arm from random angles around level, at rest, for 2 s."""
    q = np.random.default_rng(0).uniform(-half_width, half_width, (batch, 3))
    return Problem(
        "fig5-random-2s",
        fj.scenes.fig5().linkage,
        fj.State(q, np.zeros_like(q)),
        (),
        np.array([0.0, 2.0]),
        "RRR",
    )


def mixed_batch(batch: int) -> Problem:
    """Returns random arms of all topologies, from random states, for 2 s."""
    rng = np.random.default_rng(2)
    arms = [random_linkage(t, rng) for t in rng.choice(fj.TOPOLOGIES, batch)]
    linkage = jax.tree.map(lambda *leaves: jnp.stack(leaves), *arms)
    state0 = _random_state(rng, (batch, 3))
    return Problem("mixed-random-2s", linkage, state0, (), np.array([0.0, 2.0]))


def controller(tolerance: Any) -> diffrax.PIDController:
    # An array, so that another tolerance is not another compilation.
    tolerance = jnp.asarray(tolerance, dtype=float)
    smallest = 1e-13 if jax.config.jax_enable_x64 else 1e-8  # ends solves gone NaN
    return diffrax.PIDController(
        rtol=tolerance, atol=tolerance, dtmin=smallest, force_dtmin=False
    )


@eqx.filter_jit
def _reference(linkage, state0, ts, forces, axes):
    def member(linkage, state0):
        return fj.simulate(
            linkage,
            state0,
            ts,
            forces,
            solver=diffrax.Dopri8(),
            stepsize_controller=controller(REFERENCE_TOLERANCE),
            max_steps=None,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        ).q

    return jax.vmap(member, axes)(linkage, state0) if axes else member(linkage, state0)


def reference(problem: Problem, chunk: int = 1024) -> np.ndarray:
    """Returns joint positions at the output times, at a tolerance of 1e-13."""
    linkage, state0 = problem.linkage, problem.state0
    if problem.batch is None:
        motion = _reference(linkage, state0, problem.ts, problem.forces, None)
        return np.asarray(motion)
    parts = []
    for start in range(0, problem.batch, chunk):
        members = slice(start, start + chunk)
        arms = linkage
        if problem.axes[0] == 0:
            arms = jax.tree.map(lambda leaf, m=members: leaf[m], linkage)
        begin = fj.State(state0.q[members], state0.qd[members])
        parts.append(
            np.asarray(
                _reference(arms, begin, problem.ts, problem.forces, problem.axes)
            )
        )
    return np.concatenate(parts)
