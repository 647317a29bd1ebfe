"""The next motion cuts the largest standard error, as the next fit shows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR

import fdof_jax as fj
from fdof_jax.identification import design

pytestmark = pytest.mark.slow
TS, KNOTS, NOISE = np.linspace(0, 1, 51), np.linspace(0, 1, 3), 1e-3
START = fj.State(jnp.array([-1.5]), jnp.zeros(1))


class Pushed(eqx.Module):
    """A link with efforts at knots; its mass and its damping are sought."""

    efforts: jax.Array

    def __call__(self, p):
        linkage = BAR.replace(mass=p["mass"][None], inertia=[0.2])
        efforts = fj.forces.EffortHistory(KNOTS, self.efforts)
        return fj.Scene(linkage, START, (efforts, fj.JointDamper(p["damping"])), 1.0)


def speeds(scene, solution):
    return solution.qd / 3


TRUE = dict(mass=jnp.asarray(2.0), damping=jnp.asarray(0.5))
GUESS = dict(mass=1.6, damping=1.0)
HANGS = {"efforts": np.zeros((3, 1))}
PUSHED = {"efforts": np.ones((3, 1))}  # from rest, rounding would decide
LIMITS = dict(noise=NOISE, bounds={"efforts": (-8, 8)}, within=speeds)


def recorded(pushed, seed):
    scene = jax.tree.map(jnp.asarray, pushed(TRUE))
    motion = fj.simulate(scene.linkage, scene.state0, TS, scene.forces)
    clean = np.asarray(fj.identification.link_ends(scene, motion))
    return clean + NOISE * np.random.default_rng(seed).normal(size=clean.shape), motion


@pytest.fixture(scope="module")
def found():
    first = Pushed(HANGS["efforts"])
    return fj.fit(first, GUESS, TS, recorded(first, 0)[0], noise=NOISE)


@pytest.fixture(scope="module")
def chosen(found):
    return fj.identification.next_motion(Pushed, found, PUSHED, TS, **LIMITS)


def relative(found):
    values = np.concatenate([np.ravel(v) for v in found.parameters.values()])
    return np.sqrt(np.diag(found.covariance)) / np.abs(values)


def test_the_next_fit_has_the_standard_errors_expected(found, chosen):
    assert chosen.improvement > 3
    first, then = Pushed(HANGS["efforts"]), Pushed(chosen.motion["efforts"])
    seen, motion = recorded(then, 1)
    both = [recorded(first, 0)[0], seen]
    fitted = fj.fit([first, then], GUESS, TS, np.stack(both), noise=NOISE)
    for name, errors in chosen.standard_errors.items():
        np.testing.assert_allclose(fitted.standard_errors[name], errors, rtol=0.05)
    gain = relative(found).max() / relative(fitted).max()
    assert gain == pytest.approx(chosen.improvement, rel=0.05)
    # Within its limits, and at one of them at least
    efforts, speed = np.abs(chosen.motion["efforts"]), np.abs(speeds(None, motion))
    assert efforts.max() <= 8 and speed.max() < 1.01
    assert speed.max() > 0.9 or efforts.max() == 8
    assert f"the largest {chosen.improvement:.3g} times less" in str(chosen)
    assert f"{chosen.motion['efforts'][0, 0]:.4g}" in str(chosen)


def test_the_gradient_of_the_largest_standard_error(found, chosen, monkeypatch):
    """By central differences, half way between the first motion and the chosen one."""
    seen = []
    lanes = design.Lanes
    monkeypatch.setattr(design, "Lanes", lambda *a: seen.append(lanes(*a)) or seen[0])
    fj.identification.next_motion(Pushed, found, HANGS, TS, max_steps=1, **LIMITS)
    z = 0.5 * chosen.motion["efforts"].ravel()[None] / 4
    at = lambda z: seen[0](z, np.zeros(1, int))
    slope = lambda step: (at(z + step).loss[0] - at(z - step).loss[0]) / 2e-3
    slopes = np.array(list(map(slope, 1e-3 * np.eye(z.size))))
    least = 1e-3 * np.abs(slopes).max()
    np.testing.assert_allclose(at(z).gradient[0], slopes, rtol=1e-3, atol=least)


def test_parameters_that_nothing_has_told_yet(found):
    """An infinite standard error of one number leaves what is known of the others."""
    covariance = found.covariance.copy()
    covariance[0] = covariance[:, 0] = np.inf
    sizes = 10.0 ** np.arange(2)
    known = design._information(covariance / np.outer(sizes, sizes))
    expected = np.linalg.inv(found.covariance[1:, 1:]) * np.outer(sizes, sizes)[1:, 1:]
    np.testing.assert_allclose(known[1:, 1:], expected, rtol=1e-4)
    np.testing.assert_array_equal(known[0], [1e-6, 0])
    untold = eqx.tree_at(lambda found: found.covariance, found, covariance)
    options = dict(max_steps=5) | LIMITS
    chosen = fj.identification.next_motion(Pushed, untold, HANGS, TS, **options)
    assert chosen.improvement == np.inf
    assert np.isfinite(chosen.standard_errors["mass"])
