"""Efforts given at times: interpolated between them, constant before and after."""

import diffrax
import equinox as eqx
import jax
import numpy as np
import pytest
from elements import START, arm

import fdof_jax as fj

TS = np.array([0.1, 0.25, 0.3, 0.62])
TAU = np.random.default_rng(0).normal(size=(4, 3))


def test_efforts_are_linear_between_the_times_and_held_beyond():
    history, zero = fj.forces.EffortHistory(TS, TAU), np.zeros(3)
    times = np.array([-1, 0.1, 0.17, 0.25, 0.299, 0.5, 0.62, 3])
    found = jax.vmap(lambda t: history(t, zero, zero, None))(times)
    expected = np.stack([np.interp(times, TS, column) for column in TAU.T], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_array_equal(history.jump_ts, TS)
    constant = fj.forces.EffortHistory([0.5], TAU[:1])
    np.testing.assert_array_equal(constant(0.7, zero, zero, None), TAU[0])


def momentum(linkage, q, qd):
    """Returns the momentum of the slide on the ground, which only efforts change."""
    zero = np.zeros(3)
    return fj.inverse_dynamics(linkage, q, zero, qd)[0]


@pytest.mark.slow
def test_the_momentum_gained_is_the_integral_of_the_efforts():
    linkage = eqx.tree_at(lambda k: k.gravity, arm("PRR"), 0.0)
    forces = (fj.forces.EffortHistory(TS, TAU),)
    # Trapezia, and the constant efforts before and after.
    weights = np.array([0.1 + 0.075, 0.1, 0.025 + 0.16, 0.16 + 0.08])
    expected = momentum(linkage, *START) + weights @ TAU[:, 0]
    fixed = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.01)
    for steps in ({}, fixed):  # those end at the times too, and round
        solution = fj.simulate(linkage, START, [0, 0.7], forces, **steps)
        end = momentum(linkage, solution.q[-1], solution.qd[-1])
        np.testing.assert_allclose(end, expected, atol=1e-8)


@pytest.mark.parametrize(
    "ts, tau, name",
    [
        ([0, 0], TAU[:2], "ts: expected increasing"),
        ([], np.zeros((0, 3)), "ts: expected increasing"),
        (TS, TAU[:3], "tau: expected"),
        (TS, TAU[:, 0], "tau: expected"),
    ],
)
def test_malformed_histories_are_refused(ts, tau, name):
    with pytest.raises(ValueError, match=name):
        fj.forces.EffortHistory(ts, tau)


def test_times_that_no_constructor_saw_are_checked():
    spoilt = eqx.tree_at(lambda h: h.ts, fj.forces.EffortHistory(TS, TAU), -TS)
    with pytest.raises(ValueError, match="ts: expected increasing times"):
        fj.simulate(arm("RRR"), START, [0, 0.1], (spoilt,))
    assert not jax.jit(lambda h: h.possible())(spoilt)
