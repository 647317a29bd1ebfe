"""Random scenes whose joints are held for a while, and their books of energy."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import fdof_jax as fj


class Held(NamedTuple):
    linkage: Any
    state0: Any
    forces: tuple

    def at(self, t):
        """Returns the elements at a time: payloads without mass where not taken."""
        inertial = fj.forces.InertialElement
        return tuple(e.at(t) if isinstance(e, inertial) else e for e in self.forces)

    def numbers(self):
        """Returns the numbers of start and elements that are not infinite, and back."""
        varied = eqx.filter(
            (self.state0, self.forces),
            lambda x: eqx.is_inexact_array(x) and bool(np.isfinite(x).all()),
        )
        numbers, whole = ravel_pytree(varied)

        def of_numbers(x):
            return Held(
                self.linkage, *eqx.combine(whole(x), (self.state0, self.forces))
            )

        return numbers, of_numbers


def random_scene(rng, most_joints, moving=False):
    """Returns a chain with a spring and one to four elements that hold its joints.

    `moving`: whether all joints move at the start, and so derivatives exist.
    """
    n = int(rng.integers(1, most_joints + 1))
    while True:
        topology = "".join(rng.choice(list("RRP"), n))
        if topology.count("P") <= 2 and ("R" in topology or n == 1):
            break
    turns = np.array(list(topology)) == "R"
    linkage = fj.Linkage(
        topology,
        length=rng.uniform(0.3, 1, n + 1),
        com=rng.uniform(-0.3, 0.5, (n, 2)),
        mass=rng.uniform(0.5, 2, n),
        inertia=rng.uniform(0.05, 0.3, n),
        locked=np.where(turns, rng.uniform(0, 0.3, n), rng.uniform(-1, 1, n)),
        base_angle=rng.uniform(-3, 3),
        gravity=rng.choice([0.0, 9.81]),
    )
    rests = np.zeros(n, bool) if moving else rng.random(n) > 0.7
    start = fj.State(
        rng.uniform(-0.8, 0.8, n), np.where(rests, 0, rng.uniform(-2, 2, n))
    )
    level = rng.uniform(0.05, 3, n)
    ends = np.where(rng.random((2, n)) < 0.5, rng.uniform(1, 1.05, (2, n)), np.inf)
    begin = rng.uniform(0.2, 1)
    holding = [
        fj.forces.JointFriction(level, static=level * rng.uniform(1.01, 1.5)),
        fj.forces.HardStops(-ends[0], ends[1], restitution=rng.uniform(0, 0.8, n)),
        fj.forces.Brake(int(rng.integers(1, n + 1)), begin, begin + 0.5),
        fj.forces.Payload(
            fj.Point(n, 0.2, 0.1), rng.uniform(0.2, 2), 0.1,
            begin=rng.uniform(0.2, 1), velocity=[0.1, -0.2],
        ),
    ]  # fmt: skip
    some = rng.random(4) < [0.8, 0.7, 0.4, 0.4]
    some[int(rng.integers(4))] = True
    spring = fj.forces.JointSpring(rng.uniform(1, 30, n))
    chosen = (element for element, there in zip(holding, some) if there)
    state0 = fj.State(*map(jnp.asarray, start))
    return Held(linkage, state0, (spring, *chosen))


def books(scene, motion):
    """Returns the energy and what was taken of it, and the size of the largest part.

    A payload that is taken brings its energies with it.
    """

    def energies(t, q, qd):
        kinetic, potential = fj.energy(scene.linkage, q, qd, scene.at(t))
        return jnp.stack([kinetic, potential])

    parts = np.asarray(jax.vmap(energies)(motion.ts, motion.q, motion.qd))
    taken = np.asarray(motion.taken)
    total = parts.sum(axis=1) + taken
    for element in scene.forces:
        if isinstance(element, fj.forces.Payload):
            first = np.searchsorted(motion.ts, element.begin)
            total[first:] -= total[first] - total[first - 1]
    return total, max(np.abs(parts).max(), np.abs(taken).max(), 1e-3)
