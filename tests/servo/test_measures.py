"""Measures of a motion against its reference: closed forms."""

import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.analysis import step_measures
from fdof_jax.references import Ramp, Step

SLIDE = fj.Linkage("P", mass=[1], com=[[0, 0]], inertia=[1], length=[0, 1], gravity=0)
START = fj.State([0.0], [0.0])
TS = np.linspace(-0.5, 6, 651)
STEP = Step(0.0, [0.5])
W, ZETA = 8.0, 0.3  # of the loop
PD = fj.PDController(W**2, 2 * ZETA * W, np.inf, STEP)


def measured(controller, load=0.0, since=0.0):
    forces = controller, fj.JointEffort(load)  # a load of 0 lets all share a program
    motion = fj.simulate(SLIDE, START, TS, forces)
    return fj.analysis.response(SLIDE, forces, motion, since=since)


@pytest.mark.slow
def test_a_step_of_a_slide_is_that_of_a_second_order_system():
    found = measured(PD)
    damped = np.sqrt(1 - ZETA**2)
    ts = np.linspace(0, 6, 600_001)
    phase = W * damped * ts
    swing = np.cos(phase) + ZETA / damped * np.sin(phase)
    share = 1 - np.exp(-ZETA * W * ts) * swing
    rise = ts[np.argmax(share >= 0.9)] - ts[np.argmax(share >= 0.1)]
    settled = ts[np.abs(share - 1) > 0.02].max()
    overshoot = np.exp(-np.pi * ZETA / damped)
    measures = found.overshoot, found.rise_time, found.settling_time
    exact = [overshoot], [rise], [settled]
    np.testing.assert_allclose(measures, exact, rtol=2e-3)
    np.testing.assert_allclose(found.step, 0.5)
    np.testing.assert_allclose(found.largest_error, 0.5)
    samples = 0.5 * np.interp(TS[TS >= 0], ts, 1 - share)
    np.testing.assert_allclose(found.rms_error, np.sqrt(np.mean(samples**2)), rtol=1e-5)
    assert found.saturated == 0 and found.joints == ("P1",)


@pytest.mark.slow
def test_a_step_between_samples_counts_from_its_time():
    pd = PD.replace(reference=Step(0.0, [0.5], begin=0.0037))
    coarse, fine = (
        fj.analysis.response(
            SLIDE, (pd,), fj.simulate(SLIDE, START, np.linspace(-0.5, 6, n), (pd,)),
            since=0.0037,
        )
        for n in (651, 6501)
    )  # fmt: skip
    for name in ("step", "overshoot", "rise_time", "settling_time"):
        one, other = getattr(coarse, name), getattr(fine, name)
        np.testing.assert_allclose(one, other, rtol=2e-3)


def test_a_response_that_creeps_or_fails_has_no_rise_time():
    ts = np.linspace(0, 2, 1001)
    change, rate = 1 - np.exp(-ts), np.exp(-ts)  # 0.86 at the end
    assert str(step_measures(ts, change, rate, 1.0)) == str((0.0, np.nan, np.nan))
    rise = step_measures(ts, change, rate, change[-1])[1]
    part = lambda share: -np.log1p(-share * change[-1])
    np.testing.assert_allclose(rise, part(0.9) - part(0.1), rtol=1e-3)
    assert np.isnan(step_measures(ts, np.full(1001, np.nan), rate, np.nan)).all()


@pytest.mark.slow
def test_a_load_leaves_a_steady_error():
    found = measured(PD, 3.2)
    np.testing.assert_allclose(found.steady_error, 3.2 / W**2, atol=2e-4)


@pytest.mark.slow
def test_an_actuator_at_its_limit_counts():
    # A second at full thrust out, and one back: the demand is far beyond the limit.
    pd = fj.PDController(1e6, 0.0, 0.5, Step(0.0, [0.5]))
    found = measured(pd)
    assert found.saturated > 0.95
    for kind in (
        fj.control.FirstOrderLag(pd, 0.01),
        fj.control.PIDController(1e6, 0.0, 0.0, 0.5, pd.reference),
        fj.control.FirstOrderLag(
            fj.control.PIDController(1e6, 0.0, 0.0, 0.5, pd.reference), 0.01
        ),
    ):
        assert measured(kind).saturated > 0.9


@pytest.mark.slow
def test_a_reference_that_moves_has_errors_alone():
    ramp = Ramp([0, 1], [[0.0], [1.0]])
    found = measured(fj.PDController(W**2, 2 * W, np.inf, ramp))
    # The error of a critically damped loop is t exp(-W t) while the ramp lasts.
    np.testing.assert_allclose(found.largest_error, np.exp(-1) / W, rtol=1e-3)
    assert np.isnan([found.overshoot, found.rise_time, found.settling_time]).all()
    after = measured(fj.PDController(W**2, 2 * W, np.inf, ramp), since=1.0)
    assert after.largest_error < np.exp(-1) / W


@pytest.mark.slow
def test_sampled_control_is_measured_as_it_acted():
    # A unit mass under efforts held for 1/8 s, which act a period late.
    period, limit = 0.125, 0.8
    pd = fj.PDController(2.0, 2.0, limit, Step(0.0, [0.5], begin=0.375))
    q, qd, path, held = 0.0, 0.0, [], [0.0]
    for k in range(200):
        path.append(q)
        wanted = 0.5 * (k * period >= 0.375)
        held.append(np.clip(2 * (wanted - q) - 2 * qd, -limit, limit))
        q, qd = q + period * qd + period**2 / 2 * held[k], qd + period * held[k]
    path = np.array([*path, q])
    lag = fj.control.FirstOrderLag(fj.JointDamper(0.0), 0.1)
    for forces in ((), (lag,)):
        motion = fj.simulate_sampled(
            SLIDE, START, pd, period, 200, forces, delay=period
        )
        found = fj.analysis.response(SLIDE, (pd, *forces), motion, since=0.375)
        np.testing.assert_allclose(found.step, 0.5, atol=1e-12)
        at = np.abs(held[3:]) == limit
        np.testing.assert_allclose(found.saturated, at.mean(), atol=1e-12)
        assert 0 < at.sum() < 20
        np.testing.assert_allclose(found.steady_error, path[-1] - 0.5, atol=1e-9)
        error = path[3:] - 0.5
        np.testing.assert_allclose(found.rms_error, np.sqrt(np.mean(error**2)))
        within = abs(found.overshoot - (path.max() - 0.5) / 0.5)
        assert within < 0.01 and found.overshoot > 0
    # A drive that is sampled: its command has no state of its own in the motion.
    drive = fj.control.FirstOrderLag(pd, 0.1)
    motion = fj.simulate_sampled(SLIDE, START, drive, period, 100)
    assert fj.analysis.response(SLIDE, (drive,), motion, since=0.375).overshoot > 0
    with pytest.raises(ValueError, match="control, .forces. of a sampled motion"):
        fj.analysis.response(SLIDE, (), motion)


@pytest.mark.slow
def test_a_report_is_shown():
    text = str(measured(PD))
    assert text.count("\n") == 2 and "steady error" in text and "P1" in text
    away = str(measured(PD, 3.2))
    assert "P1 ends 11 % of its step away from the reference" in away
    still = PD.replace(reference=Step(0.0, [0.0]))
    assert "P1: no step, as it begins at its reference" in str(measured(still))
    ramp = PD.replace(reference=Ramp([0, 1], [[0.0], [1.0]]))
    assert "P1: no step, as its reference moves meanwhile" in str(measured(ramp))
