"""Profiles of point-to-point motions, and the shock against residual vibration."""

import jax
import numpy as np
import pytest

from fdof_jax.references import Travel
from fdof_jax.references.timing import PROFILES


@jax.jit
def _derivatives(travel, times):
    rate = jax.grad(travel)
    return [jax.vmap(f)(times) for f in (travel, rate, jax.grad(rate))]


def derivatives(travel, times=np.linspace(0, 3, 1201)):
    """Returns the way, its rate and its second derivative."""
    return map(np.asarray, _derivatives(travel, times))


# The largest speed and acceleration, in units of the way per duration, and squared.
LARGEST = {
    "harmonic": (np.pi / 2, np.pi**2 / 2),
    "cycloidal": (2.0, 2 * np.pi),
    "quintic": (15 / 8, 10 / np.sqrt(3)),
    "trapezoidal": (4 / 3, 16 / 3),
}


@pytest.mark.parametrize("profile", PROFILES)
def test_a_profile_leads_from_start_to_end_and_rests_there(profile):
    """Steps end where its acceleration jumps; a quintic's does not."""
    travel, times = Travel(2.0, begin=0.5, profile=profile), np.linspace(0, 3, 1201)
    way, rate, second = derivatives(travel, times)
    before, after = times < 0.5, times >= 2.5
    assert (way[before] == 0).all() and (way[after] == 1).all()
    assert (rate[before] == 0).all() and (rate[after] == 0).all()
    assert abs(rate[200]) < 1e-16 and (np.diff(way[200:1001]) > 0).all()
    np.testing.assert_allclose(way[200:1001] + way[1000:199:-1], 1, atol=1e-14)
    speed, acceleration = LARGEST[profile]
    assert rate.max() == pytest.approx(speed / 2, rel=1e-3)
    assert np.abs(second).max() == pytest.approx(acceleration / 4, rel=1e-2)
    inside = [1.0, 2.0] if profile == "trapezoidal" else []
    np.testing.assert_allclose(travel.jump_ts, [0.5, *inside, 2.5], rtol=1e-15)
    jumps = times[1:][np.abs(np.diff(second)) > 0.3]
    expected = travel.jump_ts if profile in ("harmonic", "trapezoidal") else []
    np.testing.assert_allclose(jumps, expected, atol=0.003)


@pytest.mark.parametrize("frequency", [2.0, 7.0])
def test_the_shock_takes_the_load_s_frequency_out(frequency):
    """A load on a spring follows x'' + w^2 x = -a; its integral is in closed form.

    The velocity then jumps at both ends.
    """
    plain = Travel(1.5, profile="harmonic")
    turn = frequency * 1.5
    content = np.cos(turn / 2) / (1 - (turn / np.pi) ** 2)
    shock = content / (content - np.sin(turn / 2) / (turn / 2))
    times = (np.arange(20_000) + 0.5) * 1.5 / 20_000
    wave, residual = np.exp(1j * frequency * times), []
    for travel in (plain, plain.replace(shock=shock)):
        way, rate, _ = derivatives(
            travel, np.append(times, [0, -1e-9, 1.5, 1.5 - 1e-9])
        )
        residual.append(abs(np.mean(rate[:-4] * wave)))
    assert residual[0] > 1e-3 and residual[1] < 1e-8
    np.testing.assert_allclose(rate[-4:], [shock / 1.5, 0, 0, shock / 1.5], atol=1e-8)
    assert way[-2] == 1
