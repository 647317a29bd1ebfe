"""Scenes whose joints are held for a while: closed forms, and laws at random.

Scenes of as many joints share programs, which compile for minutes each.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.forces import HardStops, JointFriction

NEVER, LATER = 8e3, 9e3  # after the end of all motions [s]
TS = np.linspace(0, 2, 41)


# Closed forms


class Row(NamedTuple):
    """A scene of some numbers, and what is known of its motion: all of `exact`.

    - `exact`: q, qd, taken and modes at `ts[1:]`, t of the (last) events, and `last`,
      the time of the last.
    - `events`: what happens, in order.
    """

    scene: Callable[..., fj.Scene]
    numbers: tuple
    ts: Any
    exact: Callable[..., dict] = lambda *numbers: {}
    events: list | None = None


def known(motion):
    """Returns what rows may know of the last joint."""
    rows = dict(q=motion.q, qd=motion.qd, modes=motion.modes)
    found = {name: row[1:, -1] for name, row in rows.items()}
    t = motion.events.t
    return found | dict(taken=motion.taken[1:], t=t, last=jnp.nanmax(t))


def check_known(found, exact, name, **bounds):
    for key, wanted in exact.items():
        got = found[key][: len(wanted)] if key == "t" else found[key]
        np.testing.assert_allclose(got, wanted, err_msg=f"{name}, {key}", **bounds)


def check_motion(row, name):
    motion = fj.simulate(row.scene(*row.numbers), row.ts)
    check_known(known(motion), row.exact(*row.numbers), name, rtol=1e-9, atol=1e-9)
    # To be held is to be held exactly.
    assert not (motion.qd * (motion.modes > 0)).any()
    if row.events is not None:
        assert motion.events.table["event"].tolist() == row.events


@eqx.filter_jit(**LOOPS)
@eqx.filter_vmap
def _changed(scene, change, ts):
    """Returns what is known of motions, and how it changes with the scenes."""
    motion = lambda scene: known(fj.simulate(scene, ts, adjoint=diffrax.ForwardMode()))
    return eqx.filter_jvp(motion, (scene,), (change,))


def check_derivatives(rows):
    """Checks derivatives in all numbers, by one program for a batch of all rows."""
    names, members, right = [], [], []
    for name, row in rows.items():
        for axis in np.eye(len(row.numbers)):
            pair = row.numbers, tuple(axis)
            scene, change = eqx.filter_jvp(row.scene, *pair)
            numbers = eqx.filter(scene, eqx.is_inexact_array)
            change = eqx.combine(change, jax.tree.map(jnp.zeros_like, numbers))
            members.append((scene, change, jnp.array(row.ts, float)))
            right.append(jax.jvp(lambda *x, row=row: row.exact(*x), *pair))
            names.append(name)
    found = _changed(*jax.tree.map(lambda *parts: jnp.stack(parts), *members))
    for k, (name, wanted) in enumerate(zip(names, right)):
        for of_all, exact in zip(found, wanted):
            # What never changes, as modes, has no derivative.
            keys = [key for key in exact if of_all[key] is not None]
            member, exact = ({key: of[key] for key in keys} for of in (of_all, exact))
            member = {key: value[k] for key, value in member.items()}
            check_known(member, exact, name, rtol=1e-9, atol=1e-9)


# Random scenes


class Held(NamedTuple):
    linkage: Any
    state0: Any
    forces: tuple

    def at(self, t):
        """Returns the elements at a time: payloads without mass where not taken."""
        inertial = fj.forces.InertialElement
        return tuple(e.at(t) if isinstance(e, inertial) else e for e in self.forces)

    def numbers(self):
        """Returns the numbers of start and elements, and back to a scene."""
        varied = self.state0, self.forces
        numbers, whole = ravel_pytree(eqx.filter(varied, eqx.is_inexact_array))

        def of_numbers(x):
            return Held(self.linkage, *eqx.combine(whole(x), varied))

        return numbers, of_numbers


def random_scene(rng, moving=False):
    """Returns one to five joints, with a spring and one to four elements that hold.

    The others of the four are there too, but never act.

    `moving`: whether all joints move at the start, and so derivatives exist.
    """
    n = int(rng.integers(1, 6))
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
    static = level * rng.uniform(1.01, 1.5)
    restitution, braked = rng.uniform(0, 0.8, n), int(rng.integers(1, n + 1))
    mass, taken = rng.uniform(0.2, 2), rng.uniform(0.2, 1)
    some = rng.random(4) < [0.8, 0.7, 0.4, 0.4]
    some[int(rng.integers(4))] = True
    rubs, stops, brakes, carries = some
    begin, taken = begin if brakes else NEVER, taken if carries else NEVER
    lower, upper = np.where(stops, ends, np.inf)
    forces = (
        fj.forces.JointSpring(rng.uniform(1, 30, n)),
        JointFriction(rubs * level, static=rubs * static),
        HardStops(-lower, upper, restitution=restitution),
        fj.forces.Brake(braked, begin, begin + 0.5),
        fj.forces.Payload(
            fj.Point(n, 0.2, 0.1), mass, 0.1, begin=taken, velocity=[0.1, -0.2]
        ),
    )
    return Held(linkage, fj.State(*map(jnp.asarray, start)), forces)


def law_errors(scene):
    """Returns the errors of a scene's laws, as parts of their bounds."""
    # At the default tolerance some energies are off by 2e-9.
    options = dict(rtol=1e-12, atol=1e-12)
    motion = fj.simulate(scene.linkage, scene.state0, TS, scene.forces, **options)
    efforts = fj.joint_efforts(scene.linkage, scene.forces, motion)
    parts, qdd = map(np.asarray, _along(scene, motion, efforts.total))
    _, friction, stops, _, load = scene.forces
    ts, q, taken, held = map(
        np.asarray, (motion.ts, motion.q, motion.taken, motion.modes)
    )
    held = held > 0
    total = parts.sum(axis=1) + taken
    if (first := np.searchsorted(ts, load.begin)) < len(ts):  # it brings its energies
        total[first:] -= total[first] - total[first - 1]
    off = np.abs(total - total[0])
    off /= max(np.abs(parts).max(), np.abs(taken).max(), 1e-3)
    level = np.where(held, friction.static, friction.level)
    outside = np.maximum(np.asarray(stops.lower) - q, q - np.asarray(stops.upper))
    return {
        "energy at the end": off[-1] / 1e-9,
        # Between ends of steps, states are less exact.
        "energy on the way": off.max() / 1e-8,
        "rates of held joints": np.inf if (motion.qd * held != 0).any() else 0.0,
        "accelerations of held joints": np.abs(qdd * held).max() / 1e-8,
        "friction above its level": (abs(efforts.elements[1]) - level).max() / 1e-9,
        "positions beyond stops": outside.max() / 1e-12,
    }


@eqx.filter_jit
def _along(scene, motion, efforts):
    """Returns energies, and accelerations under the efforts of all elements."""

    def at(t, q, qd, effort):
        state, forces = (scene.linkage, q, qd), scene.at(t)
        energies = jnp.stack(fj.energy(*state, forces))
        return energies, fj.forward_dynamics(*state, effort, forces)

    return jax.vmap(at)(motion.ts, motion.q, motion.qd, efforts)
