"""Ensembles for robust tuning: the loss over all members, and one that fails."""

import equinox as eqx
import numpy as np
import pytest
from scipy import signal
from test_limits import FINE, step

import fdof_jax as fj

BAR = step()
MASSES = np.random.default_rng(1).uniform(1.6, 4, 3)
INERTIAS = 0.3 + MASSES * (0.6**2 + 0.2**2)  # about the pivot


@pytest.mark.slow
def test_the_loss_is_a_power_mean_of_the_members_and_one_that_fails_is_named():
    arms = (BAR.linkage.replace(mass=[mass]) for mass in MASSES)
    ensemble = fj.tuning.stacked([BAR._replace(linkage=arm) for arm in arms])
    tune = lambda ensemble, **options: fj.tune(
        BAR, ensemble=ensemble, loss=fj.tuning.joint_errors, max_steps=4, **options
    )
    for over, order in ("mean", 1), ("worst", 32):
        found = tune(ensemble, over=over)
        expected = np.mean(found.member_loss**order) ** (1 / order)
        assert found.loss == pytest.approx(expected)
    kp, kd = found.gains[:, 0]
    # The reference stands, so that kd damps only.
    steps = (signal.step(([kp], [i, kd, kp]), T=FINE)[1] for i in INERTIAS)
    losses = [np.mean((q[::40] - 1) ** 2) for q in steps]
    np.testing.assert_allclose(losses, found.member_loss, rtol=1e-5)
    inertias = lambda many: (many.linkage.mass, many.linkage.inertia)
    none_in_second = [np.array([[1.0], [0], [1]]) * a for a in inertias(ensemble)]
    ensemble = eqx.tree_at(inertias, ensemble, none_in_second)
    message = r"ensemble\[1\]: expected one that can be simulated"
    with pytest.raises(ValueError, match=message):
        tune(ensemble)


def test_gains_of_computed_torque_have_units_of_their_own(tuned):
    (pd,) = tuned.scene.forces
    torque = fj.control.ComputedTorque(100.0, 20.0, pd.limit, pd.reference)
    scene = tuned.scene._replace(forces=(torque,))
    words = str(eqx.tree_at(lambda result: result.scene, tuned, scene))
    assert "kp of P2 [1/s^2]" in words and "kd of R1 [1/s]" in words
