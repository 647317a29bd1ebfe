"""A fixed pair of no length and no mass, put into an arm, changes nothing elsewhere.

That holds for elements, controllers, motions and analyses; the arm of three joints is
tested in the files of each.
"""

from functools import partial
from typing import Any

import elements
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import SHORT

import fdof_jax as fj

pytestmark = pytest.mark.slow
ARM, VALUES = elements.arm("RPR"), {n: np.asarray(v) for n, v in elements.ARM.items()}
PLACE = 1  # of the fixed pair, behind the first link
LONGER = fj.Linkage(
    "RFPR", length=np.insert(VALUES["length"], 2, 0), base_angle=ARM.base_angle,
    com=np.insert(VALUES["com"], PLACE, [0.3, 0.2], axis=0),
    mass=np.insert(VALUES["mass"], PLACE, 0),
    inertia=np.insert(VALUES["inertia"], PLACE, 0),
    locked=np.insert(np.asarray(ARM.locked), PLACE, 0),
)  # fmt: skip


class Padded(eqx.Module):
    """A reference of the shorter arm, for the longer one."""

    reference: Any

    def __call__(self, t, linkage):
        return tuple(map(padded, self.reference(t, ARM)))


def padded(tree):
    """Returns values of the longer arm; the fixed pair's are those of its neighbour."""

    def of(leaf):
        if isinstance(leaf, fj.Linkage):
            return LONGER
        if isinstance(leaf, fj.Point):
            return leaf.replace(link=leaf.link + (leaf.link > PLACE))
        if isinstance(leaf, elements.Swing | elements.Hold):
            return Padded(leaf)
        if isinstance(leaf, fj.control.Actuators):  # most of it is per actuator
            rows = dict(gear=of(leaf.gear), effort_lower=of(leaf.effort_lower))
            return leaf.replace(**rows)
        per_joint = jnp.shape(leaf)[-1:] == (3,)
        return jnp.insert(leaf, PLACE, leaf[..., PLACE], axis=-1) if per_joint else leaf

    whole = fj.Linkage, fj.Point, elements.Swing, elements.Hold, fj.control.Actuators
    return jax.tree.map(of, tree, is_leaf=lambda part: isinstance(part, whole))


def without_fixed(tree):
    """Returns values of the shorter arm; those that are not per joint stay."""
    less = lambda row: np.delete(row, PLACE, axis=-1) if row.shape[-1] == 4 else row
    return jax.tree.map(less, tree)


Q, QD, QDD, TAU = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (4, 3)))
PD = fj.PDController([90.0, 70.0, 50.0], 2.0, np.inf, elements.Hold(Q))
# At points, with masses and with states; all act in `test_elements_act_alike`.
SOME = tuple(elements.ALL[name] for name in ("spring", "actuator", "motor with PID"))
MASSES = tuple(elements.WITH_INERTIA.values())
MOVE = fj.references.JointMove(Q, Q + 1, fj.references.Travel(1.0, profile="harmonic"))


def acts(arm, q, qd, forces):
    states = [jax.tree.map(lambda x: x + 0.1, e.initial_state(arm)) for e in forces]
    return [e.act(0.1, q, qd, arm, state) for e, state in zip(forces, states)]


def moves(arm, q, qd, forces):
    motion = fj.simulate(arm, fj.State(q, qd), [0, 0.01, 0.02], forces, **SHORT)
    efforts = fj.joint_efforts(arm, forces, motion)
    reactions = fj.joint_reactions(arm, forces, motion)
    return motion.q, motion.qd, efforts.total, efforts.elements, reactions.mT


def follows(arm, q, qd, move):
    joints = (1, 3) if arm is ARM else (1, PLACE + 1, 4)  # a fixed one is ignored
    forces = fj.simulation.PrescribedMotion(joints, move), fj.JointDamper(0.5)
    motion = fj.simulate(arm, fj.State(q, 0 * qd), [0, 0.05, 0.1], forces)
    return motion.q, motion.qd, fj.joint_efforts(arm, forces, motion).elements


def balanced(arm, q, qd, pd):
    return fj.analysis.equilibrium(arm, 0.9 * q, (pd,))


def dynamics(arm, q, qd, qdd, tau, forces):
    regressor = fj.analysis.regressor(arm, q, qd, qdd)
    return (
        fj.forward_dynamics(arm, q, qd, tau, forces),
        fj.inverse_dynamics(arm, q, qd, qdd, forces),
        jnp.tensordot(regressor, fj.analysis.inertial_parameters(arm), 2),
        fj.analysis.holding_efforts(arm, q),
    )


def compare(found, expected, name=""):
    for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, err_msg=name)


# What is computed of an arm at (q, qd), and further arguments; 0 at fixed pairs.
COMPARED = {
    "dynamics": (dynamics, (QDD, TAU, MASSES)),
    "motion": (moves, (SOME,)),
    "equilibrium": (balanced, (PD,)),
    "prescribed": (follows, (MOVE,)),
}


@pytest.mark.parametrize("name", COMPARED)
def test_motions_and_analyses(name):
    function, arguments = COMPARED[name]
    # The arms are known to the programs, which leave out other joints.
    of = lambda arm, *at: eqx.filter_jit(partial(function, arm))(*at)
    shorter = of(ARM, Q, QD, *arguments)
    longer = of(LONGER, padded(Q), padded(QD), *padded(arguments))
    if name == "motion":
        *shorter, bearings = shorter
        *longer, more_bearings = longer
        compare(bearings, without_fixed(more_bearings))
        # The bearing before a pair of no mass carries what the next one does.
        before, behind = more_bearings[..., PLACE], more_bearings[..., PLACE + 1]
        compare(before[:, :2], behind[:, :2])
    for row in jax.tree.leaves(longer):
        np.testing.assert_array_equal(row[..., PLACE], 0)
    compare(shorter, without_fixed(longer))


def test_elements_act_alike():
    names, forces = zip(*(elements.ALL | elements.HOLDING).items())
    run = eqx.filter_jit(acts)  # one program for all of them
    q, qd = (padded(row).at[PLACE].set(0) for row in (Q, QD))  # as programs do
    longer = without_fixed(run(LONGER, q, qd, padded(forces)))
    for name, one, other in zip(names, run(ARM, Q, QD, forces), longer, strict=True):
        compare(other, one, name=name)
