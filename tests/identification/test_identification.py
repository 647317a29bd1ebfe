"""Identification: exact without noise, at the Cramér-Rao bound with it; verdicts."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.identification import result as fit_result
from fdof_jax.tuning import search

TS = np.linspace(0, 2, 201)
ARM = fj.Linkage(
    "RPR", length=[0, 1, 0.8, 0.6], com=[[0.5, 0], [0.4, 0.1], [0.3, 0]],
    mass=[3, 2, 1], inertia=[0.3, 0.1, 0.04],
)  # fmt: skip


def sines(t, q, qd, linkage):
    """Known efforts that excite all joints."""
    return jnp.array([20.0, 8.0, 3.0]) * jnp.sin(jnp.array([5.0, 7.0, 9.0]) * t)


def recorded(scene, observe=fj.identification.link_ends):
    """Returns the readings without noise, by `simulate` at its default tolerance."""
    solution = fj.simulate(scene.linkage, scene.state0, TS, scene.forces)
    return np.asarray(observe(scene, solution))


def jacobian(readings, parameters, h=1e-4):
    """Returns central differences of readings in each single number, (reading, n)."""
    columns = []
    for name, value in parameters.items():
        for index in np.ndindex(np.shape(value)):
            step = np.zeros(np.shape(value))
            step[index] = h * np.abs(np.asarray(value)[index])
            moved = (jnp.asarray(value + s * step) for s in (1, -1))
            ends = (readings(parameters | {name: to}) for to in moved)
            columns.append(np.subtract(*ends).ravel() / (2 * step[index]))
    return np.stack(columns, axis=1)


class Mixed(eqx.Module):
    """Unknowns of an arm: the third link's mass and offset, an inertia, all damping."""

    start: fj.State

    def __call__(self, p):
        arm = ARM.replace(
            com=ARM.com.at[2, 1].set(p["offset"]),
            mass=ARM.mass.at[2].set(p["mass"]),
            inertia=ARM.inertia.at[1].set(p["inertia"]),
        )
        return fj.Scene(arm, self.start, (sines, fj.JointDamper(p["damping"])), 0.0)


MIXED, OTHER = (
    Mixed(fj.State(jnp.array(q), jnp.zeros(3)))
    for q in ([-1.0, 0.3, 0.2], [0.1, 0.5, 0.5])
)
of_mixed, of_other = (lambda p, at=at: recorded(at(p)) for at in (MIXED, OTHER))
TRUE = dict(mass=1.2, inertia=0.15, offset=-0.08, damping=[2.0, 3.0, 0.2])
TRUE = {name: jnp.asarray(value) for name, value in TRUE.items()}
FIRST = dict(mass=0.9, inertia=0.2, offset=-0.05, damping=[1.0, 1.0, 0.3])


def errors_of(result):
    of = lambda name: np.ravel(result.parameters[name] - np.asarray(TRUE[name]))
    return np.concatenate([of(name) for name in TRUE])


@cache
def clean():
    """Returns two motions of the same arm (recording, ...)."""
    return np.stack([of_mixed(TRUE), of_other(TRUE)])


@cache
def noisy():
    return clean() + 1e-3 * np.random.default_rng(0).normal(size=clean().shape)


@pytest.mark.slow
def test_the_parameters_are_as_exact_as_the_noise_lets_them_be():
    """2 s at 100 Hz with 1 mm of noise, fifty times, from a poor first guess.

    Beside them are a recording without noise, one of which more than half is missing,
    and one that drifts, which another motion tells.
    """
    noise, draws, seen = 1e-3, 50, clean()[0]
    slopes, rng = jacobian(of_mixed, TRUE), np.random.default_rng(0)
    covariance_by = lambda rows: noise**2 * np.linalg.inv(rows.T @ rows)
    covariance = covariance_by(slopes)
    bound = np.sqrt(np.diag(covariance))
    drawn = seen + noise * rng.normal(size=(draws + 3, *seen.shape))
    there = rng.uniform(size=seen.shape) < 0.4
    drawn[0], drawn[1] = seen, np.where(there, drawn[1], np.nan)
    drawn[-1] += np.array([0.0, 0.02]) * TS[:, None, None]
    exact, sparse, *results, drifted = fj.identification.fit_each(
        MIXED, FIRST, TS, drawn, noise=noise, validate=(OTHER, noisy()[1])
    )
    assert exact.converged and exact.rms < 1e-6 and (np.diff(exact.history) < 0).all()
    np.testing.assert_allclose(errors_of(exact), 0, atol=1e-7)
    np.testing.assert_allclose(exact.covariance, covariance, rtol=1e-3, atol=1e-9)
    assert exact.names[2:] == ("offset", "damping[0]", "damping[1]", "damping[2]")
    least = np.sqrt(np.diag(covariance_by(slopes[there.ravel()])))
    assert (np.abs(errors_of(sparse)) < 3.5 * least).all()
    np.testing.assert_allclose(sparse.standard_errors["damping"], least[3:], rtol=0.05)
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


class FirstLink(eqx.Module):
    """Unknowns: the first link's mass, mass centre and inertia about its start."""

    ef: jax.Array

    def __call__(self, p):
        arm = ARM.replace(
            topology=self.ef,
            com=ARM.com.at[0, 0].set(p["p"]),
            mass=ARM.mass.at[0].set(p["m"]),
            inertia=ARM.inertia.at[0].set(p["J"] - p["m"] * p["p"] ** 2),
        )
        return fj.Scene(arm, MIXED.start, (sines, fj.JointDamper(jnp.ones(3))), 0.0)


def encoders(scene, solution):
    return solution.q


LINK = dict(m=jnp.asarray(3.0), p=jnp.asarray(0.5), J=jnp.asarray(1.1))


@pytest.mark.slow
def test_what_the_motion_does_not_tell():
    """A link on the ground's pivot shows only its m p and J."""
    scene_at, first = FirstLink(ARM.ef), dict(m=2.5, p=0.4, J=1.3)
    readings, noise = recorded(scene_at(LINK), encoders), np.array([1e-3, 1e-3, 2e-3])
    result = fj.fit(scene_at, first, TS, readings, observe=encoders, noise=noise)
    assert result.converged and result.rms < 1e-6
    errors, found = result.standard_errors, result.parameters
    assert errors["m"] == errors["p"] == np.inf and errors["J"] < 0.1
    assert found["m"] * found["p"] == pytest.approx(1.5, abs=1e-5)
    assert found["J"] == pytest.approx(1.1, abs=1e-5)
    (words,) = result.weak
    assert "not change with: m by +1 % and p by -1 % together" in words
    assert result.faults == ("the motion does not determine all parameters",)
    # The encoder of a fixed pair is right without noise. As a reading, it would make
    # the noise of the others seem less.
    scene_at = FirstLink(fj.existence_factors("RRF"))
    draw = np.random.default_rng(0).normal(size=readings.shape) * [1, 1, 0]
    seen = recorded(scene_at(LINK), encoders) + 1e-3 * draw
    result = fj.fit(scene_at, LINK, TS, seen, observe=encoders)
    assert not seen[:, 2].any() and result.noise == pytest.approx(1e-3, rel=0.05)


def test_hardly_told_combinations_are_named():
    bent = np.array([[4.0, -3.99], [-3.99, 4.0]])
    (words,) = fit_result._in_words(("a", "b"), np.zeros((2, 0)), bent)
    assert "283 %" in words and "a by" in words and "b by" in words


# Verdicts, by recordings that a fit has not seen. Where no noise is given, changes
# between residuals estimate it independently.


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-3, None])
def test_a_fit_that_predicts_another_motion_to_its_noise(noise):
    """Residuals of a wrong model would pass for noise, and hide other errors."""
    given, lines = (MIXED, FIRST, TS, noisy()[0]), []
    held_out = dict(noise=noise, validate=(OTHER, noisy()[1]))
    stopped = fj.fit(*given, report=lines.append, max_steps=1)
    assert stopped.faults == ("the search has not converged",) and len(lines) >= 3
    compiled = search._evaluate.__wrapped__._cached._cache_size()
    found, judged = fj.fit(*given, noise=noise), fj.fit(*given, **held_out)
    assert search._evaluate.__wrapped__._cached._cache_size() == compiled
    assert found.usable and "not tested on held-out" in str(found).splitlines()[0]
    assert judged.usable and str(judged).startswith("No fault is known, on held-out")
    np.testing.assert_array_equal(judged.covariance, found.covariance)
    predicted = of_other(judged.parameters)
    error = np.sqrt(np.mean((predicted - noisy()[1]) ** 2)) / (noise or judged.noise)
    tolerance = 1e-4 if noise else 0.05
    np.testing.assert_allclose(judged.held_out, (error,), rtol=tolerance)
    wrong = fj.fit(*given, bounds=dict(mass=(0.5, 1.0), damping=(0, 10)), **held_out)
    assert wrong.parameters["mass"] == 1.0 and "mass is at its bound" in wrong.message
    assert wrong.converged and "the residuals exceed the noise" in wrong.faults
    assert wrong.noise * (noise or 1) > 1.5e-3 and wrong.held_out[0] > 1.5
    assert wrong.rms == pytest.approx(wrong.noise * (noise or 1), rel=0.01)


@pytest.mark.slow
def test_a_wrong_model_is_told_by_another_motion_alone():
    """Wrong by 7 % in one inertia, which the other parameters hide from the fit."""
    noise = 5e-3
    draw = np.random.default_rng(1).normal(size=noisy().shape)
    seen, other = noisy() + noise * draw
    options = dict(bounds=dict(inertia=(0.16, 0.2)), noise=noise)
    alike, wrong = (
        fj.fit(MIXED, FIRST, TS, seen, **options, validate=held_out)
        for held_out in ((MIXED, seen), (OTHER, other))
    )
    assert alike.usable and wrong.converged and not wrong.usable
    (fault,), matrix = wrong.faults, jacobian(of_other, wrong.parameters)
    excess = np.sum(matrix @ wrong.covariance * matrix) / len(matrix)
    expected = np.sqrt(1 + excess / noise**2)
    assert f"exceed the noise ({expected:.3g} times the noise is expected" in fault
    assert str(wrong).startswith("Not to be used: the held-out residuals exceed")
    assert wrong.held_out[0] > 1.2 > alike.held_out[0]


def test_angles_that_wrap_are_named():
    """A rotor that slows down: q = (1 - exp(-d t)) 8 / d, as encoders read it."""
    rotor = fj.Linkage("R", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])

    def slowing(p):
        damper = fj.JointDamper(p["damping"])
        return fj.Scene(rotor, fj.State([0.0], [8.0]), (damper,), 2.0)

    angle = (1 - np.exp(-0.5 * TS)) * 8 / 0.5
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    for readings, wraps in (wrapped, True), (np.unwrap(wrapped), False):
        first = {"damping": 0.4}
        found = fj.fit(slowing, first, TS, readings[:, None], observe=encoders)
        assert (found.usable, "numpy.unwrap" in str(found)) == (not wraps, wraps)
    np.testing.assert_allclose(found.parameters["damping"], 0.5, rtol=1e-6)


# A scene that holds joints

RODS = fj.scenes.double_pendulum().linkage
BENT = fj.State([0.3, -0.2], [0.0, 0.0])
MOVE = fj.references.JointMove(BENT.q, [0.8, 0.6], fj.references.Travel(0.7))
CONTROL = fj.PDController([200, 40], [20, 1], 100, MOVE)
TIMES, NOISE = np.linspace(0, 1.5, 151), 1e-4


def held_at(p):
    level, static = (jnp.stack([0.0, p[name]]) for name in ("level", "static"))
    friction = fj.forces.JointFriction(level, static)
    ends = -np.inf, [np.inf, 0.1]
    stops = fj.forces.HardStops(*ends, restitution=p["restitution"])
    load = fj.forces.Payload(fj.Point(2, 0.8), p["mass"], begin=p["time"])
    return fj.Scene(RODS, BENT, (CONTROL, friction, stops, load), 1.5)


def seen_at(p):
    motion = fj.simulate(held_at(p), TIMES, rtol=1e-13, atol=1e-13)
    return fj.identification.link_ends(held_at(p), motion)


@pytest.mark.slow
def test_standard_errors_through_all_that_holds():
    """Those from extrapolated differences of tight solves; the truth is within four."""
    truth = dict(level=1.0, static=2.0, restitution=0.6, mass=0.4, time=0.25)
    seen = seen_at(jax.tree.map(jnp.array, truth))
    seen += NOISE * np.random.default_rng(0).normal(size=seen.shape)
    start = dict(level=1.3, static=2.5, restitution=0.4, mass=0.5, time=0.28)
    bounds = dict(restitution=(0.05, 0.95))
    found = fj.fit(held_at, start, TIMES, seen, noise=NOISE, bounds=bounds)
    assert found.usable
    fine, coarse = (jacobian(seen_at, found.parameters, h) for h in (3e-5, 6e-5))
    slopes = (4 * fine - coarse) / 3
    right = NOISE * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    values, errors, true = (
        np.array([of[name] for name in found.parameters])
        for of in (found.parameters, found.standard_errors, truth)
    )
    np.testing.assert_allclose(errors, right, rtol=1e-4)
    assert (np.abs(values - true) < 4 * errors).all()
