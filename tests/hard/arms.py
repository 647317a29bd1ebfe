"""What the hard scenes have in common: the usual arm, its start and tolerances."""

import json
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fdof_jax as fj

# Made by make_driven_reference.py.
REFERENCE = json.loads((Path(__file__).parent / "driven_reference.json").read_text())

USUAL = dict(
    length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 1], inertia=[1 / 12] * 3
)
START = fj.State(np.array([-0.5, 0.3, 0.2]), np.zeros(3))
TIGHT = diffrax.PIDController(rtol=1e-12, atol=1e-12)


def arm(topology="RRR", **changes):
    """Links of 1 m and 1 kg, unless a scene says otherwise."""
    return fj.Linkage(topology, **{**USUAL, **changes})


class Hold(eqx.Module):
    """A reference that stands still."""

    target: jax.Array

    def __call__(self, t, linkage):
        return self.target, jnp.zeros(3)


# Where the controllers of the scenes hold the arm [rad], as in driven_reference.json.
TARGET = Hold(jnp.array([-0.4, 0.2, 0.3]))
