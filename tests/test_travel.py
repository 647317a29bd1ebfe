"""Profiles of point-to-point motions, and the shock against residual vibration."""

import jax
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.references.timing import PROFILES

TIMES = np.linspace(0, 2, 201)


@jax.jit
def _derivatives(travel, times):
    rate = jax.grad(travel)
    return [jax.vmap(f)(times) for f in (travel, rate, jax.grad(rate))]


def derivatives(travel, times=TIMES):
    """Returns the way, its rate and its second derivative."""
    return map(np.asarray, _derivatives(travel, times))


rates = jax.jit(jax.vmap(jax.grad(lambda t, travel: travel(t)), (0, None)))


@pytest.mark.parametrize("profile", PROFILES)
def test_a_profile_leads_from_start_to_end_and_rests_there(profile):
    travel = fj.references.Travel(2.0, begin=0.5, profile=profile)
    way, rate, _ = derivatives(travel, np.linspace(0, 3, 301))
    assert (way[:51] == 0).all() and (way[-50:] == 1).all()
    assert (rate[:50] == 0).all() and (rate[-50:] == 0).all()
    assert abs(rate[50]) < 1e-16
    assert (np.diff(way[50:251]) > 0).all()
    np.testing.assert_allclose(way[50:251] + way[250:49:-1], 1, atol=1e-14)


@pytest.mark.parametrize(
    "profile, speed, acceleration",
    [
        # In units of the way per duration, and per duration squared.
        ("harmonic", np.pi / 2, np.pi**2 / 2),
        ("cycloidal", 2.0, 2 * np.pi),
        ("quintic", 15 / 8, 10 / np.sqrt(3)),
        ("trapezoidal", 4 / 3, 16 / 3),
    ],
)
def test_largest_speed_and_acceleration(profile, speed, acceleration):
    _, rate, second = derivatives(fj.references.Travel(2.0, profile=profile))
    assert rate.max() == pytest.approx(speed / 2, rel=1e-3)
    assert np.abs(second).max() == pytest.approx(acceleration / 4, rel=1e-2)


def test_a_shock_is_a_jump_of_the_velocity_at_both_ends():
    travel = fj.references.Travel(2.0, begin=1.0, profile="harmonic", shock=0.3)
    rate = lambda t: rates(np.array([t]), travel)[0]
    assert rate(1.0 - 1e-9) == 0 and rate(1.0) == pytest.approx(0.15)
    assert rate(3.0 - 1e-9) == pytest.approx(0.15) and rate(3.0) == 0
    assert travel(3.0) == 1
    np.testing.assert_allclose(travel.jump_ts, [1, 3])


@pytest.mark.parametrize("frequency", [2.0, 7.0])
def test_the_shock_takes_the_load_s_frequency_out(frequency):
    """A load on a spring follows x'' + w^2 x = -a; its integral is in closed form."""
    plain = fj.references.Travel(1.5, profile="harmonic")
    turn = frequency * 1.5
    content = np.cos(turn / 2) / (1 - (turn / np.pi) ** 2)
    shock = content / (content - np.sin(turn / 2) / (turn / 2))
    shocked = plain.replace(shock=shock)
    times = (np.arange(200_000) + 0.5) * 1.5 / 200_000
    residual = [
        abs(np.mean(np.asarray(rates(times, t)) * np.exp(1j * frequency * times)))
        for t in (plain, shocked)
    ]
    assert residual[0] > 1e-3 and residual[1] < 1e-8


@pytest.mark.parametrize("profile", PROFILES)
def test_steps_end_where_the_acceleration_jumps(profile):
    """Only the third derivative of a quintic jumps, at both ends."""
    travel = fj.references.Travel(2.0, begin=0.5, profile=profile)
    inside = [1.0, 2.0] if profile == "trapezoidal" else []
    np.testing.assert_allclose(travel.jump_ts, [0.5, *inside, 2.5], rtol=1e-15)
    times = np.linspace(0.4, 2.6, 1101)
    _, _, second = derivatives(travel, times)
    jumps = times[1:][np.abs(np.diff(second)) > 0.3]
    if profile in ("harmonic", "trapezoidal"):
        np.testing.assert_allclose(jumps, travel.jump_ts, atol=0.003)
    else:
        assert not len(jumps)
