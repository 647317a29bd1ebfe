"""Arms, states, elements and times of two precisions go together, in the wider one."""

import itertools
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import ALL, HOLDING, START, arm
from modes import ADJOINT, LOOPS, jacobian

import fdof_jax as fj

ARM, TS = arm("RPR"), jnp.array([0.0, 0.1])
# At points, in joints, with masses, with a path, and holding
NAMES = "spring", "wrench", "actuator", "gravity", "sticking friction", "taken"
FORCES = tuple((ALL | HOLDING)[name] for name in NAMES)
TIP = fj.CircleTask([0.2, 0.2], 0.05)


def cast(tree, dtype):
    arrays, others = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda x: x.astype(dtype), arrays), others)


def at_an_instant(linkage, state, forces, ts):
    q, qd = state
    rows = ts, jnp.stack([q, q]), jnp.stack([qd, qd])
    masses = tuple(e.at(ts[1]) for e in forces if hasattr(e, "at"))
    motion = fj.Solution(*rows, {}, diffrax.RESULTS.successful)
    return (
        fj.tip_position(linkage, q),
        fj.inverse_kinematics(linkage, TIP.tip(ts[1]), 0.3),
        fj.energy(linkage, q, qd, masses),
        fj.forward_dynamics(linkage, q, qd, q, masses),
        fj.joint_efforts(linkage, forces, motion),
        fj.joint_reactions(linkage, forces, motion),
        fj.linearize(linkage, state, forces[:2], ts[1]),
    )


PAIRS = list(itertools.product((np.float32, np.float64), repeat=4))


@pytest.mark.parametrize("kinds", PAIRS, ids=lambda k: "-".join(t.__name__ for t in k))
def test_any_precisions_go_together(kinds):
    given = map(cast, (ARM, START, FORCES, TS), kinds)
    shapes = eqx.filter_eval_shape(at_an_instant, *given)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(shapes)} == {"float64"}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*double precision")
def test_motions_of_arms_in_single_precision():
    def motion(linkage, forces):
        return fj.simulate(linkage, START, TS, forces, throw=False)

    short = cast(ARM, np.float32)
    shape = eqx.filter_eval_shape(motion, short, (*FORCES, ALL["motor"]))
    assert shape.q.dtype == np.float64
    # Its motion is that of an arm in double precision with the same numbers.
    spring, wide = (ALL["spring"],), cast(short, np.float64)
    found, right = motion(short, spring), motion(wide, spring)
    np.testing.assert_allclose(found.q, right.q, rtol=0, atol=1e-14)
    assert found.outcome == "successful" and found.q.dtype == np.float64


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*double precision")
def test_derivatives_of_an_arm_in_single_precision():
    """In all modes they are those of an arm in double precision."""
    short = cast(ARM, np.float32)

    def end(q, linkage=short, **options):
        start, spring = fj.State(q, START.qd), (ALL["spring"],)
        return fj.simulate(linkage, start, TS, spring, **options).q[-1].sum()

    forward = partial(end, adjoint=diffrax.ForwardMode())
    wide = partial(forward, linkage=cast(short, np.float64))
    expected, _ = jacobian(wide)(START.q)
    found = [jacobian(forward)(START.q)[0]]
    for of in (end, partial(end, adjoint=ADJOINT)):
        found.append(jax.jit(jax.grad(of), **LOOPS)(START.q))
    np.testing.assert_allclose(found, np.tile(expected, (3, 1)), atol=1e-9)


def test_an_arm_in_single_precision_is_named():
    short = cast(ARM, np.float32)
    with pytest.warns(
        UserWarning, match=r"^linkage: expected numbers in double .*buil"
    ):
        jax.eval_shape(lambda: fj.simulate(short, START, TS))
