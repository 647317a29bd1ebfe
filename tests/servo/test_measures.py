"""Measures of a motion against its reference, of motions in closed form."""

import equinox as eqx
import jax
import numpy as np
import pytest
from figures import made_up

import fdof_jax as fj
from fdof_jax.analysis import response, step_measures
from fdof_jax.references import Ramp, Step

SLIDE = fj.Linkage("P", mass=[1], com=[[0, 0]], inertia=[1], length=[0, 1], gravity=0)
TS = np.linspace(-0.5, 6, 651)
W, ZETA = 8.0, 0.3  # of the loop


def pd_of(reference, limit=np.inf, kp=W**2, kd=2 * ZETA * W):
    return fj.PDController(kp, kd, limit, reference)


def share_of_step(ts):
    """Returns the answer to a step by 1 at 0 s, and its rate."""
    since, damped = np.maximum(ts, 0), W * np.sqrt(1 - ZETA**2)
    decay, turn = np.exp(-ZETA * W * since), damped * since
    swing = np.cos(turn) + ZETA * W / damped * np.sin(turn)
    return 1 - decay * swing, W**2 / damped * decay * np.sin(turn)


def stepped(begin, to=0.5, ts=TS):
    return made_up(ts, *(to * row[:, None] for row in share_of_step(ts - begin)))


@pytest.mark.parametrize("begin", [0.0, 0.0037])  # at a sample, and between two
def test_a_step_of_a_slide_is_that_of_a_second_order_system(begin):
    pd = pd_of(Step(0.0, [0.5], begin=begin))
    found = response(SLIDE, (pd,), stepped(begin), since=begin)
    ts = np.linspace(0, 6, 600_001)
    share, _ = share_of_step(ts)
    rise = ts[np.argmax(share >= 0.9)] - ts[np.argmax(share >= 0.1)]
    settled = ts[np.abs(share - 1) > 0.02].max()
    overshoot = np.exp(-np.pi * ZETA / np.sqrt(1 - ZETA**2))
    measures = found.overshoot, found.rise_time, found.settling_time
    np.testing.assert_allclose(measures, [[overshoot], [rise], [settled]], rtol=2e-3)
    np.testing.assert_allclose([found.step, found.largest_error], 0.5, rtol=1e-4)
    errors = 0.5 * np.interp(np.append(begin, TS[begin < TS]) - begin, ts, 1 - share)
    np.testing.assert_allclose(found.rms_error, np.sqrt(np.mean(errors**2)), rtol=1e-5)
    assert found.saturated == 0 and found.joints == ("P1",)


def test_a_response_that_creeps_or_fails_has_no_rise_time():
    ts = np.linspace(0, 2, 1001)
    change, rate = 1 - np.exp(-ts), np.exp(-ts)  # 0.86 at the end
    assert str(step_measures(ts, change, rate, 1.0)) == str((0.0, np.nan, np.nan))
    rise = step_measures(ts, change, rate, change[-1])[1]
    part = lambda share: -np.log1p(-share * change[-1])
    np.testing.assert_allclose(rise, part(0.9) - part(0.1), rtol=1e-3)
    assert np.isnan(step_measures(ts, np.full(1001, np.nan), rate, np.nan)).all()


def with_states(motion, *elements):
    """Returns the motion with the elements' states, all as at the start."""
    rows = lambda leaf: np.broadcast_to(leaf, (len(motion.ts), *np.shape(leaf)))
    own = tuple(jax.tree.map(rows, e.initial_state(SLIDE)) for e in elements)
    return eqx.tree_at(lambda m: m.own, motion, own)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["PD", "lag", "PID", "lag of PID"])
def test_an_actuator_at_its_limit_counts(kind):
    """Its command, not what a lag lets through, is at the limit."""
    acts = pd_of(Step(0.0, [0.5]), limit=10.0)
    if "PID" in kind:
        acts = fj.control.PIDController(W**2, 0.0, 2 * ZETA * W, 10.0, acts.reference)
    acts = fj.control.FirstOrderLag(acts, 0.01) if "lag" in kind else acts
    share, rate = share_of_step(TS)
    motion = stepped(0.0) if kind == "PD" else with_states(stepped(0.0), acts)
    wanted = W**2 * 0.5 * ((TS >= 0) - share) - 2 * ZETA * W * 0.5 * rate
    at = np.abs(wanted[TS >= 0]) >= 10
    assert 0.02 < at.mean() < 0.2
    found = response(SLIDE, (acts,), motion, since=0.0)
    np.testing.assert_allclose(found.saturated, at.mean())


@pytest.mark.slow
def test_a_reference_that_moves_has_errors_alone():
    """The error of a critically damped loop is t exp(-W t) while a ramp lasts."""
    ramp, error = Ramp([0, 1], [[0.0], [1.0]]), lambda t: t * (t > 0) * np.exp(-W * t)
    slope = lambda t: (t > 0) * (1 - W * t) * np.exp(-W * t)
    q = np.clip(TS, 0, 1) - error(TS) + error(TS - 1)
    qd = (TS > 0) * (TS <= 1) - slope(TS) + slope(TS - 1)
    motion = made_up(TS, q[:, None], qd[:, None])
    forces = (pd_of(ramp, kd=2 * W),)
    found = response(SLIDE, forces, motion)
    np.testing.assert_allclose(found.largest_error, np.exp(-1) / W, rtol=1e-3)
    assert np.isnan([found.overshoot, found.rise_time, found.settling_time]).all()
    assert response(SLIDE, forces, motion, since=1.5).largest_error < 0.1 / W
    assert "P1: no step, as its reference moves meanwhile" in str(found)


@pytest.mark.slow
def test_sampled_control_is_measured_as_it_acted():
    # A unit mass under efforts held for 1/8 s, which act a period late.
    period, limit = 0.125, 0.8
    pd = pd_of(Step(0.0, [0.5], begin=0.375), limit, 2.0, 2.0)
    q, qd, path, held = 0.0, 0.0, [], [0.0]
    for k in range(200):
        path.append(q)
        wanted = 0.5 * (k * period >= 0.375)
        held.append(np.clip(2 * (wanted - q) - 2 * qd, -limit, limit))
        q, qd = q + period * qd + period**2 / 2 * held[k], qd + period * held[k]
    path = np.array([*path, q])
    lag = fj.control.FirstOrderLag(fj.JointDamper(0.0), 0.1)
    start = fj.State([0.0], [0.0])
    motion = fj.simulate_sampled(SLIDE, start, pd, period, 200, (lag,), delay=period)
    found = response(SLIDE, (pd, lag), motion, since=0.375)
    at = np.abs(held[3:]) == limit
    assert 0 < at.sum() < 20
    np.testing.assert_allclose(found.saturated, at.mean(), atol=1e-12)
    np.testing.assert_allclose(found.steady_error, path[-1] - 0.5, atol=1e-9)
    errors = path[3:] - 0.5
    np.testing.assert_allclose(found.rms_error, np.sqrt(np.mean(errors**2)))
    assert abs(found.overshoot - (path.max() - 0.5) / 0.5) < 0.01
    # A drive that is sampled: its command has no state of its own in the motion.
    drive = fj.control.FirstOrderLag(pd, 0.1), lag
    assert response(SLIDE, drive, motion, since=0.375).overshoot > 0
    with pytest.raises(ValueError, match="control, .forces. of a sampled motion"):
        response(SLIDE, (), motion)


def test_a_report_tells_steps_and_what_a_load_leaves():
    forces = (pd_of(Step(0.0, [0.5])),)
    ends = stepped(0.0, 0.5), stepped(0.0, 0.55)
    steps, away = (response(SLIDE, forces, motion, since=0.0) for motion in ends)
    assert str(steps).count("\n") == 2 and "steady error" in str(steps)
    np.testing.assert_allclose(away.steady_error, 0.05, atol=2e-4)
    assert "P1 ends 10 % of its step away from the reference" in str(away)
    still = response(SLIDE, (pd_of(Step(0.0, [0.0])),), stepped(0.0, 0.0))
    assert "P1: no step, as it begins at its reference" in str(still)
