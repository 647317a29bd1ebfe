"""Fits are judged by recordings that they have not seen."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_identification import FIRST, MIXED, TRUE, TS, Mixed, jacobian, recorded

import fdof_jax as fj
from fdof_jax.identification import result as fit_result
from fdof_jax.search import lanes

OTHER = Mixed(fj.State(jnp.array([0.1, 0.5, 0.5]), jnp.zeros(3)))


@pytest.fixture(scope="module")
def noisy():
    """Two motions of the same arm, the second one for validation (recording, ...)."""
    clean = np.stack([recorded(MIXED(TRUE)), recorded(OTHER(TRUE))])
    return clean + 1e-3 * np.random.default_rng(0).normal(size=clean.shape)


@pytest.mark.parametrize("noise", [1e-3, None])
def test_a_fit_that_predicts_another_motion_to_its_noise(noise, noisy):
    found = fj.fit(MIXED, FIRST, TS, noisy[0], noise=noise)
    assert found.usable and "not tested on held-out" in str(found).splitlines()[0]
    compiled = lanes._evaluate._cached._cache_size()
    judged = fj.fit(MIXED, FIRST, TS, noisy[0], noise=noise, validate=(OTHER, noisy[1]))
    assert lanes._evaluate._cached._cache_size() == compiled
    assert judged.usable and str(judged).startswith("No fault is known, on held-out")
    np.testing.assert_array_equal(judged.covariance, found.covariance)
    predicted = recorded(OTHER(judged.parameters))
    error = np.sqrt(np.mean((predicted - noisy[1]) ** 2)) / (noise or judged.noise)
    # Where no noise is given, changes between residuals estimate it independently.
    tolerance = 1e-4 if noise else 0.05
    np.testing.assert_allclose(judged.held_out, (error,), rtol=tolerance)
    assert f"held-out residuals {judged.held_out[0]:.3g} times the noise" in str(judged)


def test_a_wrong_model_is_told_by_another_motion_alone(noisy):
    """Wrong by 7 % in one inertia, which the other parameters hide from the fit."""
    bounds = dict(inertia=(0.16, 0.2))
    keywords = dict(bounds=bounds, noise=5e-3)
    rng = np.random.default_rng(1)
    noisier = noisy + 5e-3 * rng.normal(size=noisy.shape)
    found = fj.fit(MIXED, FIRST, TS, noisier[0], **keywords)
    assert found.usable and found.held_out == ()
    both = noisier[::-1]
    found = fj.fit(
        MIXED, FIRST, TS, noisier[0], validate=([OTHER, MIXED], both), **keywords
    )
    assert found.converged and not found.usable
    (fault,) = found.faults
    matrix = np.concatenate([jacobian(s, found.parameters) for s in (OTHER, MIXED)])
    excess = np.sum(matrix @ found.covariance * matrix) / len(matrix)
    expected = np.sqrt(1 + excess / 5e-3**2)
    assert f"exceed the noise ({expected:.3g} times the noise is expected" in fault
    assert str(found).startswith("Not to be used: the held-out residuals exceed")
    assert "Not to be used" in found._repr_html_()
    assert found.held_out[0] > 1.2 > found.held_out[1]


def test_a_search_that_was_stopped_is_not_to_be_used(noisy):
    found = fj.fit(MIXED, FIRST, TS, noisy[0], max_steps=1)
    assert not found.converged
    assert found.faults == ("the search has not converged",)


def falling_from(angle):
    """Returns a scene of one link, whose programs compile faster."""

    def scene_at(p):
        rod = fj.Linkage(
            "R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=p["inertia"]
        )
        start = fj.State(np.array([angle]), np.zeros(1))
        return fj.Scene(rod, start, (fj.JointDamper(p["damping"]),), 0.0)

    return scene_at


@pytest.mark.slow
def test_each_of_several_fits_is_judged():
    mine, other = map(falling_from, (0.3, -0.8))
    true = dict(inertia=jnp.array([0.1]), damping=jnp.array(0.2))
    first = dict(inertia=[0.15], damping=0.1)
    noisy = np.stack([recorded(mine(true)), recorded(other(true))])
    noisy += 1e-3 * np.random.default_rng(0).normal(size=noisy.shape)
    worse = noisy[0] + np.array([0.0, 0.02]) * TS[:, None, None]
    good, bad = fj.identification.fit_each(
        mine, first, TS, np.stack([noisy[0], worse]), validate=(other, noisy[1])
    )
    assert good.usable and not bad.usable
    assert any("held-out residuals exceed the noise" in fault for fault in bad.faults)


def test_recordings_that_cannot_validate(noisy):
    def fit(validate):
        fj.fit(MIXED, FIRST, TS, noisy[0], validate=validate)

    with pytest.raises(ValueError, match=r"validate: expected \(scene_at, observed\)"):
        fit(noisy[1])
    with pytest.raises(ValueError, match=r"validate\[0\]: expected a callable"):
        fit((3, noisy[1]))
    with pytest.raises(ValueError, match=r"validate\[1\]: expected a row for each"):
        fit((OTHER, noisy[1, :5]))
    with pytest.raises(ValueError, match=r"validate\[1\]: expected a recording for e"):
        fit(([OTHER, OTHER], noisy[:1]))
    for other in (noisy[1, :, :2], np.full_like(noisy[1], np.nan)):
        with pytest.raises(ValueError, match=r"validate\[1\]: expected recordings"):
            fit((OTHER, other))


def test_a_noise_that_is_not_given_is_told_from_errors_of_the_model(noisy):
    """Wrong by a third in one inertia, which no other parameter hides."""
    bounds = dict(inertia=(0.2, 0.3))
    found = fj.fit(MIXED, FIRST, TS, noisy[0], bounds=bounds)
    assert found.converged and found.noise > 2e-3
    assert found.faults == ("the residuals exceed the noise",)
    # Its residuals would otherwise pass for noise, and hide those of the other motion.
    found = fj.fit(
        MIXED, FIRST, TS, noisy[0], bounds=bounds, validate=(OTHER, noisy[1])
    )
    assert found.held_out[0] > 2
    exact = fj.fit(MIXED, FIRST, TS, recorded(MIXED(TRUE)))
    assert exact.usable and exact.rms < 1e-6


def test_hardly_told_combinations_are_named():
    """Checks that the message names each combination and its uncertainty."""
    words = fit_result._in_words(
        ("a", "b"), np.zeros((2, 0)), np.array([[4.0, -3.99], [-3.99, 4.0]])
    )
    assert len(words) == 1 and "283 %" in words[0], words
    assert "a by" in words[0] and "b by" in words[0]
