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

import fdof_jax as fj

# Made by make_reference.py and make_driven_reference.py of benchmarks/
REFERENCE, DRIVEN = (
    json.loads((Path(__file__).parent / name).read_text())
    for name in ("reference.json", "driven_reference.json")
)
USUAL: dict[str, Any] = dict(
    length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1, 1, 1], inertia=[1 / 12] * 3
)
START = fj.State(np.array([-0.5, 0.3, 0.2]), np.zeros(3))
OUTPUTS = 21  # of every simulation here: one compilation serves all


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
    return Scene(
        fj.Linkage(scene["topology"], **{key: scene[key] for key in links}),
        fj.State(np.array(scene["q0"]), np.array(scene["qd0"])),
        (
            fj.JointEffort(np.array(scene["effort"])),
            fj.JointDamper(np.array(scene["damping"])),
        ),
        np.linspace(0, scene["t1"], OUTPUTS),
        q=np.array(scene["q"]),
    )


def load_common(name):
    """Returns a scene of tests/reference.json, which holds fewer times."""
    scene, r = helpers.SCENES[name], helpers.load(name)
    times = [state["t"] for state in scene["states"]]
    ts = np.linspace(0, times[-1], OUTPUTS)
    rows = [int(np.flatnonzero(ts == t)[0]) for t in times]
    q = np.array([helpers.to_joint(scene, state["q"]) for state in scene["states"]])
    return Scene(r.linkage, r.state0, r.forces, ts, rows, q)


def fig5(times):
    """Returns Fig 5 at some of 0, 0.5 .. 60 s, from tests/reference.json."""
    rows = {row["t"]: row["th"] for row in helpers.REFERENCE["chaos"]["rows"]}
    angles = np.array([rows.get(t, [0.0] * 3) for t in times])
    linkage = fj.scenes.fig5().linkage
    q = np.diff(angles, axis=1, prepend=0)
    return free(linkage, np.zeros(3), np.asarray(times), q=q)


def controller(tolerance, **keywords):
    # An array, so that another tolerance is not another compilation.
    tolerance = jnp.asarray(tolerance)
    return diffrax.PIDController(rtol=tolerance, atol=tolerance, **keywords)


TIGHT = controller(1e-12)
DEFAULT = None  # the default of `simulate`


def simulate(scene, steps, **keywords):
    return fj.simulate(
        scene.linkage,
        scene.state0,
        scene.ts,
        scene.forces,
        stepsize_controller=steps,
        max_steps=10_000_000,
        **keywords,
    )


def error(motion, scene):
    """Returns the largest error of all joints and output times [m or rad]."""
    return np.abs(np.asarray(motion.q)[scene.rows] - scene.q).max()


def drift(linkage, q, qd):
    """Returns the largest change of energy over the largest kinetic energy."""
    kinetic, potential = jax.vmap(fj.energy, in_axes=(None, 0, 0))(linkage, q, qd)
    total = np.asarray(kinetic + potential)
    return np.abs(total - total[0]).max() / np.max(kinetic)


def slopes(scene):
    """Returns derivatives of the last q in q0, masses and lengths, by forward mode."""
    return _slopes(scene._replace(rows=None, q=None))  # one form, one compilation


@eqx.filter_jit
def _slopes(scene):

    def end(q0, mass, length):
        linkage = eqx.tree_at(
            lambda x: (x.mass, x.length), scene.linkage, (mass, length)
        )
        motion = fj.simulate(
            linkage,
            fj.State(q0, scene.state0.qd),
            scene.ts[jnp.array([0, -1])],
            scene.forces,
            adjoint=diffrax.ForwardMode(),
        )
        return motion.q[-1]

    return jax.jacfwd(end, argnums=(0, 1, 2))(
        jnp.asarray(scene.state0.q), scene.linkage.mass, scene.linkage.length
    )


def pulled_back(scene, weights):
    """Returns the derivative of weights . q at the end in q0, by reverse mode."""
    return _pulled_back(scene._replace(rows=None, q=None), weights)


@eqx.filter_jit
def _pulled_back(scene, weights):

    def end(q0):
        start = fj.State(q0, scene.state0.qd)
        ts = scene.ts[jnp.array([0, -1])]
        return weights @ fj.simulate(scene.linkage, start, ts, scene.forces).q[-1]

    return jax.grad(end)(jnp.asarray(scene.state0.q))


class Breaking(eqx.Module):
    """An effort of zero until a time, and NaN afterwards."""

    at: jax.Array

    def __call__(self, t, q, qd, linkage):
        return jnp.where(t > self.at, jnp.nan, 0.0) * jnp.ones_like(q)


SIZE = 256  # of every batch here: one compilation serves three files


def in_a_batch(linkages, q, qd, ts, at=1e9):
    """Returns motions of `SIZE` members, whose efforts are NaN after times `at`.

    The rows of the arguments are repeated up to that size.
    """
    at = np.broadcast_to(at, len(q))
    members = jax.tree.map(
        lambda a: np.resize(a, (SIZE, *np.shape(a)[1:])), (linkages, q, qd, at)
    )
    return _in_a_batch(*members, ts)


@jax.jit
def _in_a_batch(linkages, q, qd, at, ts):
    return jax.vmap(
        lambda linkage, q, qd, at: fj.simulate(
            linkage, fj.State(q, qd), ts, (Breaking(at),), throw=False
        )
    )(linkages, q, qd, at)


@eqx.filter_jit
def behind_the_door(linkage, q0, ts):
    """A motion of at most 99 steps, the sum of q^2 at its end, and that sum's slopes.

    The slopes are those in the masses and in q0, by reverse mode. One program serves
    three files.
    """

    def end(mass, q0):
        changed = eqx.tree_at(lambda a: a.mass, linkage, mass)
        start = fj.State(q0, START.qd)
        motion = fj.simulate(changed, start, ts, max_steps=99, throw=False)
        return jnp.sum(motion.q[-1] ** 2), motion

    derive = jax.value_and_grad(end, (0, 1), has_aux=True)
    (value, motion), slopes = derive(linkage.mass, jnp.asarray(q0))
    return motion, value, slopes


def largest_error(value, exact):
    """Returns the largest error of a derivative, over its largest entry."""
    value, exact = np.asarray(value), np.asarray(exact)
    return np.abs(value - exact).max() / np.abs(exact).max()


def without_turns(q):
    """Returns angles less their whole turns, for the angles as rounded."""
    with mpmath.workdps(50):
        turn = 2 * mpmath.pi
        return np.array(
            [float(a - turn * mpmath.nint(a / turn)) for a in map(mpmath.mpf, q)]
        )


def linear_motion(t, upright=False, links=3):
    """Returns the derivative of q(t) in q0 for usual links, hanging or upright.

    In absolute angles the energies are sums of M_ij th_i' th_j' / 2 and K_i th_i^2
    / 2.
    """
    n = np.arange(links)
    beyond = links - 1 - n  # links that hang on this one
    M = 0.5 + beyond[np.maximum.outer(n, n)]
    M[n, n] = 1 / 12 + 0.25 + beyond
    K = np.diag(9.81 * (0.5 + beyond)) * (-1 if upright else 1)
    squares, modes = np.linalg.eig(np.linalg.solve(M, K))
    grown = modes * np.cos(np.sqrt(squares.astype(complex)) * t) @ np.linalg.inv(modes)
    absolute = np.tril(np.ones((links, links)))  # from relative angles
    return np.linalg.solve(absolute, grown.real @ absolute)


_UPRIGHT, _MOVED = np.array([np.pi / 2, 0, 0]), np.array([1e-6, 0, 0])


def beside_upright():
    """Returns a scene that starts a microradian beside the upright equilibrium."""
    return free(arm(), _UPRIGHT + _MOVED, np.linspace(0, 1, OUTPUTS))


def growth_error(q):
    """Returns the relative error of that scene's growth rate while it is small."""
    scene = beside_upright()
    exact = [linear_motion(t, upright=True) @ _MOVED for t in scene.ts]
    away = np.asarray(q) - _UPRIGHT
    size, exact_size = (np.linalg.norm(a, axis=1) for a in (away, exact))
    small = size < 1e-3
    if not 5 < small.sum() < OUTPUTS:
        return np.inf
    rate, exact_rate = (np.diff(np.log(a[small])) for a in (size, exact_size))
    return np.abs(rate / exact_rate - 1).max()
