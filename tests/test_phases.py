"""Motions that go on from where another one ended."""

import jax
import numpy as np
import pytest

import fdof_jax as fj

ARM = fj.scenes.double_pendulum().linkage
START = fj.State([0.3, -0.2], [0.5, 0.0])
TS = np.linspace(0, 2, 81)
STOPS = fj.forces.HardStops(-1.7, [0.6, 0.4], restitution=0.5)
BOUNCING = fj.JointDamper(0.3), STOPS
PID = fj.control.PIDController(30.0, 20.0, 6.0, 25.0, fj.references.SetPoint(0.2))


def in_phases(forces, others=None):
    """Returns two motions, the second from where the first one ends."""
    first = fj.simulate(ARM, START, TS[:31], forces)
    own = {}
    if others is None and first.own:
        own = dict(own0=jax.tree.map(lambda rows: rows[-1], first.own))
    others = forces if others is None else others
    there = fj.State(first.q[-1], first.qd[-1])
    return first, fj.simulate(ARM, there, TS[30:], others, **own)


@pytest.mark.slow
@pytest.mark.parametrize("forces", [(PID,), BOUNCING])
def test_two_phases_are_the_whole_motion(forces):
    whole = fj.simulate(ARM, START, TS, forces)
    first, second = in_phases(forces)
    for name in ("ts", "q", "qd", "own", "modes"):
        rows = [getattr(motion, name) for motion in (first, second, whole)]
        jax.tree.map(
            lambda a, b, every: np.testing.assert_allclose(
                np.concatenate([a[:-1], b]), every, atol=1e-8
            ),
            *rows,
        )
    if whole.events is not None:
        taken = np.append(first.taken[:-1], first.taken[-1] + second.taken)
        np.testing.assert_allclose(taken, whole.taken, atol=1e-8)
        tables = [motion.events.table for motion in (first, second, whole)]
        for name in ("t [s]", "joint"):
            *parts, wanted = [table[name] for table in tables]
            np.testing.assert_allclose(np.concatenate(parts), wanted, atol=1e-8)
        assert len(tables[0]["event"]) > 0 and len(tables[2]["event"]) > 2


@pytest.mark.slow
@pytest.mark.parametrize("away", [-3, -1, 0, 1, 2, 3, 9])
def test_a_payload_is_taken_once_where_phases_meet(away):
    """In units of rounding from there."""
    bar = fj.Linkage(
        "R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12], gravity=0
    )
    begin = 0.3 + away * np.spacing(0.3)
    load = fj.forces.Payload(fj.Point(1, along=1), 1.5, begin=begin)
    first = fj.simulate(bar, fj.State([0.0], [2.0]), [0, 0.3], (load,))
    there = fj.State(first.q[-1], first.qd[-1])
    second = fj.simulate(bar, there, [0.3, 1.0], (load,))
    np.testing.assert_allclose(second.qd[-1], 4 / 11, rtol=1e-9)
    taken = first.taken[-1] + second.taken[-1]
    np.testing.assert_allclose(taken, 6 / 11, rtol=1e-9)


@pytest.mark.slow
def test_a_loss_over_phases_has_derivatives():
    def end(damping):
        light = (fj.JointDamper(damping),)
        return in_phases(light, (fj.JointDamper(2 * damping),))[1].q[-1].sum()

    found = jax.grad(end)(0.3)
    right = (end(0.3 + 1e-5) - end(0.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(found, right, rtol=1e-5)
