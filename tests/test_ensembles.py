"""Ensembles for robust tuning: the loss over all members, and one that fails."""

import equinox as eqx
import numpy as np
import pytest
from test_tuning import losses_of

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.tuning.stacks import unstacked


class TestEnsembles:
    # Of two joints, whose programs compile faster.
    small = scenes.two_link_circle()._replace(t1=1.0)

    def few(self):
        arm, draw = self.small.linkage, np.random.default_rng(1)
        masses = np.asarray(arm.mass) * draw.uniform(0.8, 2, (3, 2))
        arms = (arm.replace(mass=mass) for mass in masses)
        return fj.tuning.stacked([self.small._replace(linkage=arm) for arm in arms])

    @pytest.mark.slow
    def test_the_loss_is_the_mean_or_nearly_the_worst_of_the_members(self):
        ensemble = self.few()
        mean = fj.tune(self.small, ensemble=ensemble, max_steps=8)
        worst = fj.tune(self.small, ensemble=ensemble, over="worst", max_steps=8)
        assert mean.loss == pytest.approx(mean.member_loss.mean())
        top = worst.member_loss.max()
        assert top * 3 ** (-1 / 32) <= worst.loss <= top
        by_mean = np.mean(mean.member_loss**32) ** (1 / 32)
        assert worst.loss <= by_mean * (1 + 1e-4)
        losses = [
            losses_of(member, worst.gains[None])[0]
            for member in unstacked("ensemble", ensemble)
        ]
        np.testing.assert_allclose(losses, worst.member_loss, rtol=1e-5)

    def test_gains_of_computed_torque_have_units_of_their_own(self, tuned):
        (pd,) = tuned.scene.forces
        torque = fj.control.ComputedTorque(100.0, 20.0, pd.limit, pd.reference)
        scene = tuned.scene._replace(forces=(torque,))
        words = str(eqx.tree_at(lambda result: result.scene, tuned, scene))
        assert "kp of P2 [1/s^2]" in words and "kd of R1 [1/s]" in words

    @pytest.mark.slow
    def test_a_member_that_fails_is_named(self):
        ensemble = self.few()
        masses = lambda many: (many.linkage.mass, many.linkage.inertia)
        none_in_second = np.array([[1.0], [0.0], [1.0]])
        ensemble = eqx.tree_at(
            masses, ensemble, [none_in_second * a for a in masses(ensemble)]
        )
        message = r"ensemble\[1\]: expected one that can be simulated"
        with pytest.raises(ValueError, match=message):
            fj.tune(self.small, ensemble=ensemble)
