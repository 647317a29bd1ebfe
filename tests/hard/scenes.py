"""The hard scenes as arguments of `simulate`, and measures of their errors.

Unless a scene says otherwise: `arm()` from `START`.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from helpers import Hold as Hold
from modes import jacobian

import fdof_jax as fj

# Made by benchmarks/make_reference.py and make_driven_reference.py.
FILES = map(Path(__file__).with_name, ("reference.json", "driven_reference.json"))
REFERENCE, DRIVEN = (json.loads(path.read_text()) for path in FILES)
USUAL: dict[str, Any] = dict(
    length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 1], inertia=[1 / 12] * 3
)
START = fj.State(np.array([-0.5, 0.3, 0.2]), np.zeros(3))
OUTPUTS = 21  # of the files above


class Scene(NamedTuple):
    """Arguments of `simulate`, and the reference `q` at the times `ts[rows]`."""

    linkage: fj.Linkage
    state0: fj.State
    forces: tuple
    ts: np.ndarray
    rows: Any = ...
    q: Any = None


def arm(topology="RRR", **changes):
    """Returns links of 1 m and 1 kg, unless a scene says otherwise."""
    return fj.Linkage(topology, **(USUAL | changes))


# Where the controllers of the scenes hold the arm [rad], as in driven_reference.json.
TARGET = Hold(jnp.array([-0.4, 0.2, 0.3]))


def free(linkage, q0, ts, **reference):
    """Returns a scene from rest without efforts, compiled like those with efforts."""
    state0 = fj.State(np.array(q0, dtype=float), np.zeros(3))
    forces = fj.JointEffort(np.zeros(3)), fj.JointDamper(np.zeros(3))
    return Scene(linkage, state0, forces, ts, **reference)


def load(name):
    """Returns a scene of the files in this folder."""
    scene = (REFERENCE | DRIVEN)[name]
    links = ("length", "com", "mass", "inertia", "locked", "base_angle", "gravity")
    linkage = fj.Linkage(scene["topology"], **{key: scene[key] for key in links})
    numbers = (np.array(scene[key]) for key in ("q0", "qd0", "effort", "damping", "q"))
    q0, qd0, effort, damping, q = numbers
    forces = fj.JointEffort(effort), fj.JointDamper(damping)
    ts = np.linspace(0, scene["t1"], OUTPUTS)
    return Scene(linkage, fj.State(q0, qd0), forces, ts, q=q)


def fig5(times):
    """Returns Fig 5 at some of 0, 0.5 .. 60 s, from tests/reference.json."""
    rows = {row["t"]: row["th"] for row in helpers.REFERENCE["chaos"]["rows"]}
    angles = np.array([rows.get(t, [0.0] * 3) for t in times])
    linkage = fj.scenes.fig5().linkage
    q = np.diff(angles, axis=1, prepend=0)
    return free(linkage, np.zeros(3), np.asarray(times), q=q)


def controller(tolerance):
    # An array, so that another tolerance is not another compilation.
    tolerance = jnp.asarray(tolerance)
    return diffrax.PIDController(rtol=tolerance, atol=tolerance)


TIGHT = controller(1e-12)
DEFAULT = None  # the default of `simulate`


def simulate(scene, steps=TIGHT, **keywords):
    """Returns the scene's motion; all of one form share a program."""
    options = dict(stepsize_controller=steps, max_steps=200_000) | keywords
    return fj.simulate(scene.linkage, scene.state0, scene.ts, scene.forces, **options)


def error(motion, scene):
    """Returns the largest error of all joints and output times [m or rad]."""
    return np.abs(np.asarray(motion.q)[scene.rows] - scene.q).max()


def drift(linkage, q, qd):
    """Returns the largest change of energy over the largest kinetic energy."""
    kinetic, potential = jax.vmap(fj.energy, in_axes=(None, 0, 0))(linkage, q, qd)
    total = np.asarray(kinetic + potential)
    return np.abs(total - total[0]).max() / np.max(kinetic)


@jacobian
def _slopes(x, scene, tolerance):
    q0, mass, length = jnp.split(x, [3, 6])
    linkage = eqx.tree_at(lambda x: (x.mass, x.length), scene.linkage, (mass, length))
    start, ends = fj.State(q0, scene.state0.qd), scene.ts[jnp.array([0, -1])]
    options = dict(adjoint=diffrax.ForwardMode())
    options |= dict(stepsize_controller=controller(tolerance))
    return fj.simulate(linkage, start, ends, scene.forces, **options).q[-1]


def slopes(scene, tolerance=1e-11):
    """Returns derivatives of the last q in q0, masses and lengths, by forward mode."""
    x = np.concatenate([scene.state0.q, scene.linkage.mass, scene.linkage.length])
    found, _ = _slopes(x, scene._replace(rows=None, q=None), tolerance)
    return np.split(found, [3, 6], axis=1)


class Breaking(eqx.Module):
    """An effort of zero until a time, and NaN afterwards."""

    at: jax.Array

    def __call__(self, t, q, qd, linkage):
        return jnp.where(t > self.at, jnp.nan, 0.0) * jnp.ones_like(q)


def largest_error(value, exact):
    """Returns the largest error of a derivative, over its largest entry."""
    value, exact = np.asarray(value), np.asarray(exact)
    return np.abs(value - exact).max() / np.abs(exact).max()


def without_turns(q):
    """Returns angles less their whole turns, for the angles as rounded."""
    with mpmath.workdps(50):
        turn = 2 * mpmath.pi
        angles = map(mpmath.mpf, q)
        return np.array([float(a - turn * mpmath.nint(a / turn)) for a in angles])


def linear_motion(t, upright=False):
    """Returns the derivative of q(t) in q0 for usual links, hanging or upright."""
    # In absolute angles the energies are sums of M_ij th_i' th_j' / 2, K_i th_i^2 / 2.
    n = np.arange(3)
    beyond = 2 - n  # links that hang on this one
    M = 0.5 + beyond[np.maximum.outer(n, n)]
    M[n, n] = 1 / 12 + 0.25 + beyond
    K = np.diag(9.81 * (0.5 + beyond)) * (-1 if upright else 1)
    squares, modes = np.linalg.eig(np.linalg.solve(M, K))
    grown = modes * np.cos(np.sqrt(squares.astype(complex)) * t) @ np.linalg.inv(modes)
    absolute = np.tri(3)  # from relative angles
    return np.linalg.solve(absolute, grown.real @ absolute)
