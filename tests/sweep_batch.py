"""A batch of pendulums and slides for sweeps, and members of it that fail."""

from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from helpers import random_linkage

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

# Compilations dominate: nearly all tests share these shapes and settings.
TS = np.linspace(0, 1.5, 7)
CHUNK = 8  # also what the last few members are solved in
# As exact as the default solver of batches, which takes three times as long to compile;
# test_one_compilation.py and hard/test_batches.py use that one.
SETTINGS = dict(
    solver=LoopedDopri8(),
    stepsize_controller=diffrax.PIDController(
        rtol=1e-10, atol=1e-10, dtmin=1e-13, force_dtmin=False
    ),
    max_steps=1500,
)


class Push(eqx.Module):
    """A smooth effort; `broken` is added to it after 1 s."""

    tau: jax.Array
    broken: jax.Array

    def __call__(self, t, q, qd, linkage):
        return self.tau * jnp.sin(3 * t) + jnp.where(t > 1, self.broken, 0.0)


def members():
    """Returns a batch of linkages, starts and forces; programs of one joint are small.

    Batches of all topologies of three joints are in test_one_compilation.py.
    """
    rng = np.random.default_rng(6)
    linkages = [random_linkage(topology, rng) for _ in range(21) for topology in "RP"]
    size = len(linkages)
    state0 = fj.State(*rng.uniform(-1, 1, (2, size, 1)))
    push = Push(jnp.asarray(rng.uniform(-1, 1, (size, 1))), jnp.zeros(size))
    return jax.tree.map(lambda *a: jnp.stack(a), *linkages), state0, (push,)


def run(batch, **keywords):
    linkage, state0, forces = batch
    arguments = dict(SETTINGS, chunk=CHUNK, forces_axes=0)
    return fj.sweep(linkage, state0, TS, forces, **{**arguments, **keywords})


def alone(batch, member):
    linkage, state0, forces = jax.tree.map(lambda a: a[member], batch)
    return fj.simulate(linkage, state0, TS, forces, throw=False, **SETTINGS)


def read(folder):
    """Returns the bytes of all files of a store."""
    files = (path for path in Path(folder).rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


# Members that differ from the others
NAN_START, NAN_LATER, SPENT, FAST = 3, 12, 20, 0
FAILED = [NAN_START, NAN_LATER, SPENT]


def with_failures(batch):
    """Returns a batch with a fast member and members that fail in different ways."""
    linkage, (q, qd), (push,) = batch
    q, qd = q.copy(), qd.copy()
    q[NAN_START], qd[SPENT], qd[FAST] = np.nan, 1e5, 150
    push = eqx.tree_at(lambda p: p.broken, push, push.broken.at[NAN_LATER].set(jnp.nan))
    return linkage, fj.State(q, qd), (push,)
