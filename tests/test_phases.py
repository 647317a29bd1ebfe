"""Motions that follow each other, joined to one."""

import jax
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.simulation import concatenate

ARM = fj.scenes.double_pendulum().linkage
START = fj.State([0.3, -0.2], [0.5, 0.0])
TS = np.linspace(0, 2, 81)
STOPS = fj.forces.HardStops(-1.7, [0.6, 0.4], restitution=0.5)
BOUNCING = fj.JointDamper(0.3), STOPS
PID = fj.control.PIDController(30.0, 20.0, 6.0, 25.0, fj.references.SetPoint(0.2))


def in_phases(forces, others=None, ts=TS, start=START, **options):
    """Returns a motion in two phases, and both."""
    first = fj.simulate(ARM, start, ts[:31], forces, **options)
    own = {}
    if others is None and first.own:
        own = dict(own0=jax.tree.map(lambda rows: rows[-1], first.own))
    others = forces if others is None else others
    there = fj.State(first.q[-1], first.qd[-1])
    second = fj.simulate(ARM, there, ts[30:], others, **own, **options)
    return concatenate([first, second]), first, second


@pytest.mark.slow
@pytest.mark.parametrize("forces", [(PID,), BOUNCING])
def test_two_phases_are_the_whole_motion(forces):
    whole = fj.simulate(ARM, START, TS, forces)
    joined, first, second = in_phases(forces)
    rows = ("ts", "q", "qd", "own", "modes", "taken")
    for name in rows:
        one, other = getattr(joined, name), getattr(whole, name)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=1e-8), one, other
        )
    assert joined.outcome == "successful" and joined.stats["time_reached"] == 2
    for name in ("num_steps", "num_switches"):
        if name in whole.stats:
            assert joined.stats[name] == first.stats[name] + second.stats[name]
    if whole.events is not None:
        found, wanted = joined.events.table, whole.events.table
        assert found["event"].tolist() == wanted["event"].tolist()
        np.testing.assert_allclose(found["t [s]"], wanted["t [s]"], atol=1e-8)
        assert len(wanted["event"]) > 2 and np.isnan(joined.events.t[-1])
    total = fj.joint_efforts(ARM, forces, joined).total
    np.testing.assert_allclose(
        total, fj.joint_efforts(ARM, forces, whole).total, atol=1e-6
    )


@pytest.mark.slow
def test_what_acts_may_differ():
    joined, first, second = in_phases(BOUNCING, (PID,))
    assert joined.own == () and joined.modes.shape == joined.q.shape
    np.testing.assert_array_equal(joined.modes[30:], 0)
    np.testing.assert_array_equal(joined.taken[30:], first.taken[-1])
    back, *_ = in_phases((PID,), BOUNCING)
    np.testing.assert_array_equal(back.taken[:30], 0)
    np.testing.assert_array_equal(back.qd[30], fj.simulate(
        ARM, fj.State(back.q[30], back.qd[30]), [0, 1.0], BOUNCING).qd[0]
    )  # fmt: skip
    fj.plotting.motion_profile(ARM, back)
    assert len(fj.to_pandas(ARM, back)) == len(TS)


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
    motion = concatenate([first, fj.simulate(bar, there, [0.3, 1.0], (load,))])
    np.testing.assert_allclose(motion.qd[-1], 4 / 11, rtol=1e-9)
    np.testing.assert_allclose(motion.taken[-1], 6 / 11, rtol=1e-9)


@pytest.mark.slow
def test_a_batch_of_two_phases():
    starts = [fj.State(q, [0.0, 0.0]) for q in ([0.3, -0.2], [0.1, 0.2])]
    motions = [in_phases(BOUNCING, start=start) for start in starts]
    _, *phases = jax.tree.map(lambda *rows: np.stack(rows), *motions)
    joined = concatenate(phases)
    for k, (alone, *_) in enumerate(motions):
        for name in ("q", "qd", "modes", "taken"):
            one, other = getattr(joined, name)[k], getattr(alone, name)
            np.testing.assert_allclose(one, other, atol=1e-7)
        events = jax.tree.map(lambda rows, k=k: rows[k], joined.events)
        np.testing.assert_allclose(
            events.table["t [s]"], alone.events.table["t [s]"], atol=1e-7
        )


@pytest.mark.slow
def test_a_loss_over_phases_has_derivatives():
    def end(damping):
        light = (fj.JointDamper(damping),)
        return in_phases(light, (fj.JointDamper(2 * damping),))[0].q[-1].sum()

    found = jax.grad(end)(0.3)
    right = (end(0.3 + 1e-5) - end(0.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(found, right, rtol=1e-5)


@pytest.mark.slow
def test_the_first_failure_is_the_outcome():
    @jax.jit
    def joined():
        return in_phases((), throw=False, max_steps=3)[0]

    motion = joined()
    assert motion.outcome == "out of steps" and motion.stats["time_reached"] < TS[30]


@pytest.mark.parametrize(
    ("motions", "message"),
    [
        ([], "motions: expected a list of one or more Solutions"),
        ([1], r"motions\[0\]: expected a Solution"),
        (
            ["first", "first"],
            r"motions\[1\]: .* one before ends, at 0.75 s, got .* 0 s",
        ),
        (["first", "away"], r"motions\[1\]: .* positions .* got 'a gap of 1 m or rad'"),
        (["first", "other"], r"motions\[1\]: expected 2 joints and the batch \(\)"),
    ],
)
def test_what_is_refused(motions, message):
    arm, start, *_ = fj.scenes.fig5()
    known = {
        "first": fj.simulate(ARM, START, TS[:31]),
        "other": fj.simulate(arm, start, TS[30:]),
    }
    there = fj.State(known["first"].q[-1] + np.array([0, 1]), known["first"].qd[-1])
    known["away"] = fj.simulate(ARM, there, TS[30:])
    motions = [known.get(one, one) for one in motions]
    with pytest.raises(ValueError, match=message):
        concatenate(motions)


def test_one_motion_is_itself():
    motion = fj.simulate(ARM, START, TS)
    np.testing.assert_array_equal(concatenate([motion]).q, motion.q)
    np.testing.assert_array_equal(concatenate([motion]).ts, TS)
