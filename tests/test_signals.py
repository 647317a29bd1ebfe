"""Steps, pulses and ramps of a reference, against closed forms."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import fdof_jax as fj

SLIDE = fj.Linkage("P", mass=[1], com=[[0, 0]], inertia=[1], length=[0, 1], gravity=0)
TS = np.linspace(-0.55, 2.0, 26)  # none at a jump, where differences are none
W = 10.0  # of the loop, critically damped [rad/s]


def after_step(t):
    """Returns the response to a step of 1 m at 0 s."""
    t = np.maximum(t, 0)
    return 1 - (1 + W * t) * np.exp(-W * t)


def after_kink(t):
    """Returns the response to a reference that moves at 1 m/s from 0 s on."""
    t = np.maximum(t, 0)
    return t - t * np.exp(-W * t)


def of_step(before, after, begin):
    return before + (after - before) * after_step(TS - begin)


def of_pulse(outside, inside, begin, end):
    pulse = after_step(TS - begin) - after_step(TS - end)
    return outside + (inside - outside) * pulse


def of_ramp(ts, q):
    kinks = np.diff(np.diff(q[:, 0]) / np.diff(ts), prepend=0, append=0)
    return q[0, 0] + sum(kink * after_kink(TS - t) for t, kink in zip(ts, kinks))


TIMES, PLACES = np.array([0.1, 0.43, 1.07]), np.array([[0.3], [0.1], [0.8]])
CASES = [
    (fj.references.Step(0.3, [0.7], begin=0.25), of_step),
    (fj.references.Step(0.3, 0.7), of_step),
    (fj.references.Pulse(0.3, 0.7, begin=0.25, end=0.61), of_pulse),
    (fj.references.Ramp(TIMES, PLACES), of_ramp),
]


def places(reference, **options):
    pd = fj.PDController(W**2, 2 * W, np.inf, reference)
    start, _ = reference(TS[0], SLIDE)
    return fj.simulate(SLIDE, fj.State(start, 0 * start), TS, (pd,), **options).q[:, 0]


@pytest.mark.parametrize(("reference", "exact"), CASES)
def test_a_loop_answers_as_closed_forms_say(reference, exact):
    numbers, whole = ravel_pytree(reference)
    right = lambda x: np.squeeze(exact(*jax.tree.leaves(whole(x))))
    of = lambda x, **options: places(whole(x), **options)
    forward = lambda x: of(x, adjoint=diffrax.ForwardMode())
    np.testing.assert_allclose(jax.jit(of)(numbers), right(numbers), atol=1e-8)
    found = jax.jit(jax.jacfwd(forward))(numbers)
    back = jax.jit(jax.jacrev(of))(numbers)
    h = 1e-5
    steps = h * np.eye(numbers.size)
    wanted = [(right(numbers + row) - right(numbers - row)) / (2 * h) for row in steps]
    np.testing.assert_allclose(found, np.transpose(wanted), atol=1e-6)
    np.testing.assert_allclose(back, found, atol=1e-7)


def test_ramps_stand_before_and_after_their_times():
    ramp = fj.references.Ramp([0, 1, 3], [[0, 1], [1, 1], [1, -1]])
    arm = fj.scenes.double_pendulum().linkage
    rows = {
        -1: ([0, 1], [0, 0]), 0: ([0, 1], [1, 0]), 1: ([1, 1], [0, -1]),
        2: ([1, 0], [0, -1]), 3: ([1, -1], [0, 0]), 9: ([1, -1], [0, 0]),
    }  # fmt: skip
    for t, right in rows.items():
        np.testing.assert_allclose(ramp(t, arm), right, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda r: r.Pulse(0, 1, begin=2, end=1), "begin: expected less than end"),
        (lambda r: r.Ramp([0.0], [[1.0]]), "ts: expected two or more increasing"),
        (lambda r: r.Ramp([0, 1], [[1.0]]), "q: expected 2 rows, one per time, got 1"),
        (lambda r: r.Step(0, np.nan), "after: expected"),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make(fj.references)


def test_one_program_serves_signals_of_an_arm():
    arm = fj.scenes.double_pendulum().linkage
    poses = np.linspace(0, 1, 6).reshape(3, 2)
    with_reference = lambda q: fj.PDController(
        50.0, 10.0, 40.0, fj.references.Step(np.zeros(2), q, begin=0.1)
    )
    batch = eqx.filter_vmap(with_reference)(jnp.asarray(poses))
    start = fj.State(np.zeros(2), np.zeros(2))
    motions = fj.sweep(arm, start, [0, 0.5], (batch,), forces_axes=0)
    for q, motion in zip(poses, motions.q):
        alone = fj.simulate(arm, start, [0, 0.5], (with_reference(q),))
        np.testing.assert_allclose(motion, alone.q, atol=1e-8)
