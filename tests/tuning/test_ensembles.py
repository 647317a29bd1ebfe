"""Ensembles for robust tuning: the loss over all members, and one that fails."""

import equinox as eqx
import numpy as np
import pytest
from test_tuning import losses_of

import fdof_jax as fj
from fdof_jax.tuning.stacks import unstacked

# Of two joints, whose programs compile faster.
SMALL = fj.scenes.two_link_circle()._replace(t1=1.0)


def ensemble_of(masses):
    mass = np.asarray(SMALL.linkage.mass)
    arms = (SMALL.linkage.replace(mass=row * mass) for row in masses)
    return fj.tuning.stacked([SMALL._replace(linkage=arm) for arm in arms])


@pytest.mark.slow
def test_the_loss_is_a_power_mean_of_the_members_and_one_that_fails_is_named():
    ensemble = ensemble_of(np.random.default_rng(1).uniform(0.8, 2, (3, 2)))
    for over, order in ("mean", 1), ("worst", 32):
        found = fj.tune(SMALL, ensemble=ensemble, over=over, max_steps=4)
        expected = np.mean(found.member_loss**order) ** (1 / order)
        assert found.loss == pytest.approx(expected)
    members = unstacked("ensemble", ensemble)
    losses = [losses_of(member, found.gains[None])[0] for member in members]
    np.testing.assert_allclose(losses, found.member_loss, rtol=1e-5)
    inertias = lambda many: (many.linkage.mass, many.linkage.inertia)
    none_in_second = [np.array([[1.0], [0], [1]]) * a for a in inertias(ensemble)]
    ensemble = eqx.tree_at(inertias, ensemble, none_in_second)
    message = r"ensemble\[1\]: expected one that can be simulated"
    with pytest.raises(ValueError, match=message):
        fj.tune(SMALL, ensemble=ensemble)


def test_gains_of_computed_torque_have_units_of_their_own(tuned):
    (pd,) = tuned.scene.forces
    torque = fj.control.ComputedTorque(100.0, 20.0, pd.limit, pd.reference)
    scene = tuned.scene._replace(forces=(torque,))
    words = str(eqx.tree_at(lambda result: result.scene, tuned, scene))
    assert "kp of P2 [1/s^2]" in words and "kd of R1 [1/s]" in words
