"""Reference scenes, random linkages and references, shared by the tests."""

import json
import warnings
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

REFERENCE = json.loads((Path(__file__).parent / "reference.json").read_text())
SCENES = {s["id"]: s for s in REFERENCE["scenes"]}


def programs():
    """Returns an environment in which a process shares the tests' compiled programs."""
    folder = jax.config.jax_compilation_cache_dir
    if folder is None:
        return {}
    return {
        "JAX_COMPILATION_CACHE_DIR": folder,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }


class Hold(eqx.Module):
    """A reference that stands still."""

    target: jax.Array

    def __call__(self, t, linkage):
        return self.target, jnp.zeros_like(self.target)


class Push(fj.Element):
    """A force on a slide from a time on that it declares."""

    begin: fj.Values = fj.field((), unit="s")
    force: fj.Values = fj.field((), unit="N")

    def __call__(self, t, q, qd, linkage):
        return jnp.where(t >= self.begin, self.force, 0.0) * jnp.ones_like(q)

    @property
    def jump_ts(self):
        return jnp.reshape(self.begin, (1,))


class ReferenceScene(NamedTuple):
    linkage: fj.Linkage
    state0: fj.State
    forces: tuple
    x: np.ndarray
    xd: np.ndarray
    force: np.ndarray  # efforts and damping of all six joints
    tau: np.ndarray  # those of the real joints


def real_part(scene, values):
    """Returns the entries of a (6,) joint quantity that belong to real joints, (3,)."""
    return np.asarray(values)[np.asarray(scene["EF"]) == 1]


def to_joint(scene, values):
    """Returns the real joints' coordinates from chain coordinates (absolute angles)."""
    pairs = np.asarray(values, dtype=float).reshape(3, 2).copy()
    pairs[:, 1] = np.diff(pairs[:, 1], prepend=0)
    return real_part(scene, pairs.reshape(6))


def load(name):
    scene = SCENES[name]
    locked, state0 = fj.paper.from_chain(
        scene["topology"], scene["q0"], scene["v0"], scene["theta1"]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some arms are delicate on purpose
        linkage = fj.Linkage(
            scene["topology"],
            length=[*scene["A"], 1.0],
            com=np.stack([scene["p"], scene["q"]], axis=1),
            mass=scene["m"],
            inertia=scene["I"],
            locked=locked,
            base_angle=scene["theta1"],
            gravity=scene["g"],
        )
    x, xd = (np.asarray(a) for a in fj.paper.to_chain(linkage, *state0))
    damping = np.stack([scene["cP"], scene["cR"]], axis=1).reshape(6)
    rates = np.stack([xd[0::2], np.diff(xd[1::2], prepend=0)], axis=1).reshape(6)
    force = np.asarray(scene["F"]) - damping * rates
    forces = (
        fj.JointEffort(real_part(scene, scene["F"])),
        fj.JointDamper(real_part(scene, damping)),
    )
    return ReferenceScene(
        linkage, state0, forces, x, xd, force, real_part(scene, force)
    )


def relative_error(value, reference):
    value, reference = np.asarray(value), np.asarray(reference)
    return np.abs(value - reference).max() / (1 + np.abs(reference).max())


def random_linkage(topology, rng):
    n = len(topology)
    return fj.Linkage(
        topology,
        length=rng.uniform(0, 1.5, n + 1),
        com=rng.uniform(-1, 1, (n, 2)),
        mass=rng.uniform(0.5, 3, n),
        inertia=rng.uniform(0.05, 1, n),
        locked=rng.uniform(-1, 1, n),
        base_angle=rng.uniform(-3, 3),
        gravity=rng.uniform(0, 10),
    )


def random_motion(topology, rows=2, seed=0):
    """Returns a random linkage, positions and velocities, and further rows (n,)."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(topology, rng)
    return linkage, *rng.uniform(-1, 1, (rows, len(topology)))
