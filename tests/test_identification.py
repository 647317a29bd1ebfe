"""Identification is exact without noise, and meets the Cramér-Rao bound with it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.identification import result as fit_result
from fdof_jax.search import lanes

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


@pytest.fixture(scope="module")
def seen():
    return recorded(MIXED(TRUE))


def test_masses_inertias_offsets_and_damping_are_recovered(seen):
    result = fj.fit(MIXED, FIRST, TS, seen)
    assert result.converged and result.weak == ()
    np.testing.assert_allclose(errors_of(result), 0, atol=1e-7)
    assert result.names[2:] == ("offset", "damping[0]", "damping[1]", "damping[2]")
    assert (np.diff(result.history) < 0).all()


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


def test_parameters_stay_within_their_bounds_and_a_poor_fit_is_told(seen):
    bounds = dict(mass=(0.5, 1.0), damping=(0, 10))
    result = fj.fit(MIXED, FIRST, TS, seen, bounds=bounds, noise=1e-3)
    assert result.parameters["mass"] == 1.0
    assert "mass is at its bound" in result.message
    assert "times the noise" in result.message and result.noise > 1.5
    assert "the residuals exceed the noise" in result.faults
    assert result.rms == pytest.approx(1e-3 * result.noise, rel=0.01)


class FirstLink(eqx.Module):
    """Unknowns: the first link's mass, mass centre and inertia about its start."""

    ef: jax.Array

    def __call__(self, p):
        linkage = fj.Linkage(
            self.ef,
            length=LENGTH,
            com=jnp.array([[0.5, 0.0], [0.4, 0.1], [0.3, 0.0]]).at[0, 0].set(p["p"]),
            mass=jnp.asarray(MASS).at[0].set(p["m"]),
            inertia=jnp.array([0.3, 0.1, 0.04])
            .at[0]
            .set(p["J"] - p["m"] * p["p"] ** 2),
        )
        start = fj.State(jnp.array([-1.0, 0.3, 0.2]), jnp.zeros(3))
        return fj.Scene(linkage, start, (SINES, fj.JointDamper(jnp.ones(3))), 0.0)


def encoders(scene, solution):
    return solution.q


LINK = dict(m=jnp.asarray(3.0), p=jnp.asarray(0.5), J=jnp.asarray(1.1))


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
    inverse, untold = fit_result.inverse_and_null_space(normal, 1e-16)
    assert untold.shape == (4, 0)
    np.testing.assert_allclose(inverse, np.linalg.inv(normal), rtol=1e-6)
    rows[:, 3] = 2 * rows[:, 0]
    rows[:, 2] = 0
    inverse, untold = fit_result.inverse_and_null_space(rows.T @ rows, 1e-16)
    sparse = fit_result._sparse(untold)
    assert (np.abs(sparse) > 1e-9).sum(axis=1).tolist() in ([1, 2], [2, 1])
    np.testing.assert_allclose(rows @ sparse.T, 0, atol=1e-12)
    assert np.isfinite(inverse).all()


def test_recordings_judged_together(seen):
    """Two motions, in one fit, determine more than one of them does."""
    other = Mixed(fj.State(jnp.array([0.1, 0.5, 0.5]), jnp.zeros(3)))
    rng = np.random.default_rng(2)
    readings = np.stack([seen, recorded(other(TRUE))])
    readings += 1e-3 * rng.normal(size=readings.shape)
    one = fj.fit(MIXED, FIRST, TS, readings[0], noise=1e-3)
    both = fj.fit([MIXED, other], FIRST, TS, readings, noise=1e-3)
    assert both.converged and both.noise == pytest.approx(1, abs=0.1)
    errors = np.sqrt(np.diag(both.covariance))
    assert (np.abs(errors_of(both)) < 3.5 * errors).all()
    assert (errors < np.sqrt(np.diag(one.covariance))).all()


def base_parameters(linkage):
    """Returns five of the nine numbers that an RRR arm's motion determines.

    All other numbers are known. J: inertias about the starts of links with the
    masses beyond them at their ends; h: their moments m p.
    """
    mass, moment, _, inertia = fj.analysis.inertial_parameters(linkage).T
    a2, a3 = LENGTH[1:3]
    return dict(
        J2=inertia[0] + (mass[1] + mass[2]) * a2**2,
        J3=inertia[1] + mass[2] * a3**2,
        h3=moment[1] + mass[2] * a3,
        J4=inertia[2],
        h4=moment[2],
    )


def of_base_parameters(p):
    a2, a3 = LENGTH[1:3]
    beyond = jnp.array([MASS[1] + MASS[2], MASS[2], 0.0])
    moment = jnp.stack([1.5 + beyond[0] * a2, p["h3"], p["h4"]])
    ends = jnp.array([a2, a3, 0.0])
    along = (moment - beyond * ends) / MASS
    inertia = jnp.stack([p["J2"], p["J3"], p["J4"]]) - beyond * ends**2
    linkage = fj.Linkage(
        "RRR",
        length=LENGTH,
        com=jnp.stack([along, jnp.zeros(3)], axis=1),
        mass=MASS,
        inertia=inertia - MASS * along**2,
    )
    start = fj.State(jnp.array([-1.5, 0.3, 0.2]), jnp.zeros(3))
    return fj.Scene(linkage, start, (SINES,), 2.0)


ARM = fj.Linkage(
    "RRR", length=LENGTH, com=[[0.5, 0], [0.45, 0], [0.3, 0]], mass=MASS,
    inertia=[0.3, 0.15, 0.04],
)  # fmt: skip
OTHER = fj.Linkage(
    "RRR", length=LENGTH, com=[[0.5, 0], [0.55, 0], [0.22, 0]], mass=MASS,
    inertia=[0.2, 0.2, 0.03],
)  # fmt: skip


@pytest.mark.slow
def test_five_base_parameters_are_as_exact_as_the_noise_lets_them_be():
    """2 s at 100 Hz with 1 mm of noise, fifty times, from a poor first guess."""
    true, first = base_parameters(ARM), base_parameters(OTHER)
    scene_at = of_base_parameters
    clean = recorded(scene_at(true))
    slopes = jacobian(scene_at, true)
    noise, draws = 1e-3, 50
    bound = noise * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    rng = np.random.default_rng(0)
    noisy = clean + noise * rng.normal(size=(draws, *clean.shape))
    results = fj.identification.fit_each(scene_at, first, TS, noisy, noise=noise)
    assert all(result.converged and not result.weak for result in results)
    errors = np.stack([errors_of(result, true) for result in results])
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / bound
    print("rms errors over the bound:", dict(zip(true, ratio.round(3))))
    assert (ratio < 2).all()
    # Over fifty draws the ratio's own scatter is 10 %, and that of a mean a seventh.
    np.testing.assert_allclose(ratio, 1, atol=0.25)
    assert (np.abs(errors.mean(axis=0)) < 0.35 * bound).all()
    said = [np.sqrt(np.diag(result.covariance)) for result in results]
    np.testing.assert_allclose(said, np.tile(bound, (draws, 1)), rtol=0.02)


def test_progress_is_reported_and_nothing_compiles_twice(seen):
    lines = []
    fj.fit(MIXED, FIRST, TS, seen, report=lines.append, max_steps=1)
    assert len(lines) >= 3 and "sum of squares" in lines[-1]
    compiled = lanes._evaluate._cached
    before = compiled._cache_size()
    other = Mixed(fj.State(jnp.array([-0.9, 0.2, 0.2]), jnp.zeros(3)))
    fj.fit(other, TRUE, TS, 1.01 * seen, noise=0.1, max_steps=1)
    assert compiled._cache_size() == before
