"""Identification: exact without noise, at the Cramér-Rao bound with it; verdicts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.identification import result as fit_result
from fdof_jax.tuning import search

TS = np.linspace(0, 2, 201)
LENGTH, MASS = np.array([0, 1, 0.8, 0.6]), np.array([3.0, 2.0, 1.0])


class Sines(eqx.Module):
    """Known efforts that excite all joints."""

    tau: jax.Array
    rate: jax.Array

    def __call__(self, t, q, qd, linkage):
        return self.tau * jnp.sin(self.rate * t)


SINES = Sines(jnp.array([20.0, 8.0, 3.0]), jnp.array([5.0, 7.0, 9.0]))


def recorded(scene, ts=TS, observe=fj.identification.link_ends):
    """Returns the readings without noise, by `simulate` at its default tolerance."""
    # As arrays of one structure, for one compilation.
    scene = jax.tree.map(jnp.asarray, scene)
    solution = fj.simulate(scene.linkage, scene.state0, ts, scene.forces)
    return np.asarray(observe(scene, solution))


def jacobian(scene_at, parameters, observe=fj.identification.link_ends):
    """Returns central differences of `simulate` in each single number, (reading, n)."""
    columns = []
    for name, value in parameters.items():
        for index in np.ndindex(np.shape(value)):
            ends = []
            step = 1e-4 * np.abs(np.asarray(value)[index])
            for sign in (1, -1):
                moved = np.array(value, float)
                moved[index] += sign * step
                changed = parameters | {name: jnp.asarray(moved)}
                ends.append(recorded(scene_at(changed), TS, observe))
            columns.append((ends[0] - ends[1]).ravel() / (2 * step))
    return np.stack(columns, axis=1)


class Mixed(eqx.Module):
    """Unknowns of an RPR arm: link 4's mass and offset, an inertia, all damping."""

    start: fj.State

    def __call__(self, p):
        com = jnp.array([[0.5, 0.0], [0.4, 0.1], [0.3, 0.0]])
        linkage = fj.Linkage(
            "RPR",
            length=LENGTH,
            com=com.at[2, 1].set(p["offset"]),
            mass=jnp.asarray(MASS).at[2].set(p["mass"]),
            inertia=jnp.array([0.3, 0.1, 0.04]).at[1].set(p["inertia"]),
        )
        return fj.Scene(linkage, self.start, (SINES, fj.JointDamper(p["damping"])), 0.0)


MIXED = Mixed(fj.State(jnp.array([-1.0, 0.3, 0.2]), jnp.zeros(3)))
TRUE = dict(
    mass=jnp.asarray(1.2),
    inertia=jnp.asarray(0.15),
    offset=jnp.asarray(-0.08),
    damping=jnp.array([2.0, 3.0, 0.2]),
)
FIRST = dict(mass=0.9, inertia=0.2, offset=-0.05, damping=[1.0, 1.0, 0.3])


def errors_of(result, true=TRUE):
    return np.concatenate(
        [np.ravel(result.parameters[name] - np.asarray(true[name])) for name in true]
    )


OTHER = Mixed(fj.State(jnp.array([0.1, 0.5, 0.5]), jnp.zeros(3)))


@pytest.fixture(scope="module")
def clean():
    """Two motions of the same arm (recording, ...)."""
    return np.stack([recorded(MIXED(TRUE)), recorded(OTHER(TRUE))])


@pytest.fixture(scope="module")
def seen(clean):
    return clean[0]


@pytest.fixture(scope="module")
def noisy(clean):
    return clean + 1e-3 * np.random.default_rng(0).normal(size=clean.shape)


@pytest.mark.slow
def test_masses_inertias_offsets_and_damping_are_recovered(seen):
    result = fj.fit(MIXED, FIRST, TS, seen)
    assert result.converged and result.usable and result.rms < 1e-6
    np.testing.assert_allclose(errors_of(result), 0, atol=1e-7)
    assert result.names[2:] == ("offset", "damping[0]", "damping[1]", "damping[2]")
    assert (np.diff(result.history) < 0).all()
    # Errors by a given noise, whatever the residuals are.
    given = fj.fit(MIXED, FIRST, TS, seen, noise=1e-3)
    slopes = jacobian(MIXED, TRUE)
    bound = 1e-6 * np.linalg.inv(slopes.T @ slopes)
    np.testing.assert_allclose(given.covariance, bound, rtol=1e-3, atol=1e-9)


def test_a_sparse_recording_with_noise_and_its_standard_errors(seen):
    """Every second sample and more are missing; compared with differences."""
    rng = np.random.default_rng(0)
    there = rng.uniform(size=seen.shape) < 0.4
    noisy = np.where(there, seen + 1e-3 * rng.normal(size=seen.shape), np.nan)
    result = fj.fit(MIXED, FIRST, TS, noisy)
    assert result.converged and result.rms == pytest.approx(1e-3, rel=0.1)
    errors = np.sqrt(np.diag(result.covariance))
    assert (np.abs(errors_of(result)) < 3.5 * errors).all()
    slopes = jacobian(MIXED, TRUE)[there.ravel()]
    bound = result.noise**2 * np.linalg.inv(slopes.T @ slopes)
    # The bound is taken at the true parameters.
    np.testing.assert_allclose(errors, np.sqrt(np.diag(bound)), rtol=0.05)
    for name, value in result.standard_errors.items():
        assert np.shape(value) == np.shape(TRUE[name])
    table = str(result)
    assert "damping[1]" in table and "std error" in table
    assert "converged" in table and "which is not all" not in table


class FirstLink(eqx.Module):
    """Unknowns: the first link's mass, mass centre and inertia about its start."""

    ef: jax.Array

    def __call__(self, p):
        linkage = fj.Linkage(
            self.ef,
            length=LENGTH,
            com=jnp.array([[0.5, 0.0], [0.4, 0.1], [0.3, 0.0]]).at[0, 0].set(p["p"]),
            mass=jnp.asarray(MASS).at[0].set(p["m"]),
            inertia=jnp.stack([p["J"] - p["m"] * p["p"] ** 2, 0.1, 0.04]),
        )
        start = fj.State(jnp.array([-1.0, 0.3, 0.2]), jnp.zeros(3))
        return fj.Scene(linkage, start, (SINES, fj.JointDamper(jnp.ones(3))), 0.0)


def encoders(scene, solution):
    return solution.q


LINK = dict(m=jnp.asarray(3.0), p=jnp.asarray(0.5), J=jnp.asarray(1.1))


@pytest.mark.slow
def test_the_encoder_of_a_fixed_pair_is_no_reading():
    """It is right without noise, and would make the noise of the others seem less."""
    scene_at = FirstLink(fj.existence_factors("RRF"))
    readings = recorded(scene_at(LINK), TS, encoders).copy()
    assert not readings[:, 2].any()
    readings[:, :2] += 1e-3 * np.random.default_rng(0).normal(size=(len(TS), 2))
    unread = readings.copy()
    unread[:, 2] = np.nan
    found, expected = (
        fj.fit(
            scene_at, dict(m=3.1, p=0.5, J=1.12), TS, seen, observe=encoders,
            validate=(scene_at, seen),
        )
        for seen in (readings, unread)
    )  # fmt: skip
    assert found.noise == pytest.approx(1e-3, rel=0.05)
    for name in ("noise", "rms", "held_out", "standard_errors"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-6)


@pytest.mark.parametrize(
    "topology, untold, told, words",
    [
        ("RPR", ["m", "p"], ["J"], ["m by +1", "p by "]),
        ("PRR", ["p", "J"], ["m"], ["change with: p.", "change with: J."]),
    ],
)
def test_what_the_motion_does_not_tell(topology, untold, told, words):
    """A link on the ground's pivot shows only its m p and J; on its slide, only m."""
    scene_at = FirstLink(fj.existence_factors(topology))
    readings = recorded(scene_at(LINK), TS, encoders)
    first = dict(m=2.5, p=0.4, J=1.3)
    noise = np.array([1e-3, 1e-3, 2e-3])
    result = fj.fit(scene_at, first, TS, readings, observe=encoders, noise=noise)
    assert result.converged and result.rms < 1e-6
    assert not np.isnan(result.covariance).any()
    assert all(result.standard_errors[name] == np.inf for name in untold)
    assert all(result.standard_errors[name] < 0.1 for name in told)
    found = result.parameters
    if topology == "RPR":
        assert found["m"] * found["p"] == pytest.approx(1.5, abs=1e-5)
    assert all(found[n] == pytest.approx(float(LINK[n]), abs=1e-5) for n in told)
    assert all(word in " ".join(result.weak) for word in words), result.weak
    assert len(result.weak) == len(untold) - (topology == "RPR")
    assert "Not determined by this motion" in str(result)
    assert "converged in what the motion determines, which is not all" in str(result)
    assert result.faults == ("the motion does not determine all parameters",)


def test_directions_of_any_scale_are_told_from_those_that_vanish():
    rng = np.random.default_rng(1)
    size = 10.0 ** np.array([-6, 0, 5, 2])
    rows = rng.normal(size=(50, 4)) * size
    normal = rows.T @ rows
    inverse, untold = fit_result.inverse_and_null_space(normal)
    assert untold.shape == (4, 0)
    np.testing.assert_allclose(inverse, np.linalg.inv(normal), rtol=1e-6)
    rows[:, 3] = 2 * rows[:, 0]
    rows[:, 2] = 0
    inverse, untold = fit_result.inverse_and_null_space(rows.T @ rows)
    sparse = fit_result._sparse(untold)
    assert (np.abs(sparse) > 1e-9).sum(axis=1).tolist() in ([1, 2], [2, 1])
    np.testing.assert_allclose(rows @ sparse.T, 0, atol=1e-12)
    assert np.isfinite(inverse).all()


@pytest.mark.slow
def test_recordings_judged_together(noisy):
    """Two motions, in one fit, determine more than one of them does."""
    one = fj.fit(MIXED, FIRST, TS, noisy[0], noise=1e-3)
    both = fj.fit([MIXED, OTHER], FIRST, TS, noisy, noise=1e-3)
    assert both.converged and both.noise == pytest.approx(1, abs=0.1)
    errors = np.sqrt(np.diag(both.covariance))
    assert (np.abs(errors_of(both)) < 3.5 * errors).all()
    assert (errors < np.sqrt(np.diag(one.covariance))).all()


@pytest.mark.slow
def test_the_parameters_are_as_exact_as_the_noise_lets_them_be(seen, noisy):
    """2 s at 100 Hz with 1 mm of noise, fifty times, from a poor first guess.

    One more recording drifts, which another motion tells.
    """
    slopes = jacobian(MIXED, TRUE)
    noise, draws = 1e-3, 50
    bound = noise * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    rng = np.random.default_rng(0)
    drawn = seen + noise * rng.normal(size=(draws + 1, *seen.shape))
    drawn[-1] += np.array([0.0, 0.02]) * TS[:, None, None]
    *results, drifted = fj.identification.fit_each(
        MIXED, FIRST, TS, drawn, noise=noise, validate=(OTHER, noisy[1])
    )
    assert all(result.converged and not result.weak for result in results)
    assert np.mean([result.usable for result in results]) > 0.9
    words = "held-out residuals exceed the noise"
    assert any(words in fault for fault in drifted.faults) and not drifted.usable
    errors = np.stack([errors_of(result) for result in results])
    # Over fifty draws the ratio's own scatter is 10 %, and that of a mean a seventh.
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / bound
    np.testing.assert_allclose(ratio, 1, atol=0.25)
    assert (np.abs(errors.mean(axis=0)) < 0.35 * bound).all()
    said = [np.sqrt(np.diag(result.covariance)) for result in results]
    np.testing.assert_allclose(said, np.tile(bound, (draws, 1)), rtol=0.02)


# Verdicts, by recordings that a fit has not seen


@pytest.mark.parametrize("noise", [1e-3, None])
def test_a_fit_that_predicts_another_motion_to_its_noise(noise, noisy):
    found = fj.fit(MIXED, FIRST, TS, noisy[0], noise=noise)
    assert found.usable and "not tested on held-out" in str(found).splitlines()[0]
    compiled = search._evaluate.__wrapped__._cached._cache_size()
    judged = fj.fit(MIXED, FIRST, TS, noisy[0], noise=noise, validate=(OTHER, noisy[1]))
    assert search._evaluate.__wrapped__._cached._cache_size() == compiled
    assert judged.usable and str(judged).startswith("No fault is known, on held-out")
    np.testing.assert_array_equal(judged.covariance, found.covariance)
    predicted = recorded(OTHER(judged.parameters))
    error = np.sqrt(np.mean((predicted - noisy[1]) ** 2)) / (noise or judged.noise)
    # Where no noise is given, changes between residuals estimate it independently.
    tolerance = 1e-4 if noise else 0.05
    np.testing.assert_allclose(judged.held_out, (error,), rtol=tolerance)
    assert f"held-out residuals {judged.held_out[0]:.3g} times the noise" in str(judged)


@pytest.mark.slow
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


def test_a_search_that_is_stopped_reports_and_compiles_nothing_again(noisy):
    lines = []
    stopped = fj.fit(MIXED, FIRST, TS, noisy[0], report=lines.append, max_steps=1)
    assert stopped.faults == ("the search has not converged",)
    assert len(lines) >= 3 and "sum of squares" in lines[-1]
    before = search._evaluate.__wrapped__._cached._cache_size()
    fj.fit(OTHER, TRUE, TS, 1.01 * noisy[0], noise=0.1, max_steps=1)
    assert search._evaluate.__wrapped__._cached._cache_size() == before


@pytest.mark.parametrize("noise", [1e-3, None])
def test_residuals_of_a_wrong_model_exceed_the_noise(noise, noisy):
    """Also if no noise is given: else they would pass for it, and hide other errors."""
    bounds = dict(mass=(0.5, 1.0), damping=(0, 10))
    keywords = dict(bounds=bounds, noise=noise, validate=(OTHER, noisy[1]))
    found = fj.fit(MIXED, FIRST, TS, noisy[0], **keywords)
    assert found.parameters["mass"] == 1.0 and "mass is at its bound" in found.message
    assert "times the noise" in found.message and found.converged
    assert "the residuals exceed the noise" in found.faults
    assert found.noise * (noise or 1) > 1.5e-3 and found.held_out[0] > 1.5
    assert found.rms == pytest.approx(found.noise * (noise or 1), rel=0.01)


@pytest.mark.slow
def test_hardly_told_combinations_are_named():
    """Checks that the message names each combination and its uncertainty."""
    words = fit_result._in_words(
        ("a", "b"), np.zeros((2, 0)), np.array([[4.0, -3.99], [-3.99, 4.0]])
    )
    assert len(words) == 1 and "283 %" in words[0], words
    assert "a by" in words[0] and "b by" in words[0]


def test_angles_that_wrap_are_named():
    """A rotor that slows down: q = (1 - exp(-d t)) 8 / d, as encoders read it."""
    rotor = fj.Linkage("R", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])

    def slowing(p):
        start = fj.State([0.0], [8.0])
        return fj.Scene(rotor, start, (fj.JointDamper(p["damping"]),), 2.0)

    angle = (1 - np.exp(-0.5 * TS)) * 8 / 0.5
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    remarks = []
    for readings in (wrapped, np.unwrap(wrapped)):
        found = fj.fit(
            slowing, {"damping": 0.4}, TS, readings[:, None],
            observe=lambda scene, solution: solution.q,
        )  # fmt: skip
        remarks.append((found.usable, "numpy.unwrap" in str(found)))
    assert remarks == [(False, True), (True, False)]
    np.testing.assert_allclose(found.parameters["damping"], 0.5, rtol=1e-6)
