"""Ensembles for robust tuning: their members, and the loss over all of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_tuning import losses_of

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.simulation.scene import unstacked


def model_based(scene, kind):
    controller = scene.forces[0]
    replaced = kind(100.0, 20.0, controller.limit, controller.reference)
    return scene._replace(forces=(replaced,))


class TestEnsembles:
    scene = scenes.fig7()._replace(t1=1.0)
    # Of two joints, whose programs compile faster.
    small = scenes.two_link_circle()._replace(t1=1.0)
    varied = dict(payload=(0, 2), link_error=0.1, seed=1)

    def few(self):
        return fj.tuning.perturbed(self.small, 3, start_offset=0.05, **self.varied)

    @pytest.mark.slow
    def test_members_are_as_asked(self):
        draw = lambda: fj.tuning.perturbed(
            self.scene, 200, start_offset=0.3, speed=(1, 2), **self.varied
        )
        many = draw()
        mass = np.asarray(many.linkage.mass)
        assert mass.shape == (200, 3)
        assert 0.9 <= mass[:, :2].min() < 0.92 and 1.08 < mass[:, :2].max() <= 1.1
        assert mass[:, 2].min() >= 0.9 and 2.7 < mass[:, 2].max() <= 3.1
        period = np.asarray(many.forces[0].reference.period)
        assert 2.5 <= period.min() < 2.55 and 4.9 < period.max() <= 5.0
        tips = jax.vmap(fj.tip_position)(many.linkage, jnp.asarray(many.state0.q))
        nominal = fj.tip_position(self.scene.linkage, self.scene.state0.q)
        distance = np.linalg.norm(np.asarray(tips) - np.asarray(nominal), axis=1)
        assert 0.28 < distance.max() <= 0.3 + 1e-6
        # The last link keeps its angle.
        turned = np.sum(np.asarray(many.state0.q)[:, ::2], axis=1)
        np.testing.assert_allclose(turned, self.scene.state0.q[::2].sum(), atol=1e-6)
        assert eqx.tree_equal(many, draw())

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

    @pytest.mark.parametrize(
        "kind", [fj.control.GravityFeedforward, fj.control.ComputedTorque]
    )
    def test_model_based_controllers_do_not_know_the_payload(self, kind):
        many = fj.tuning.perturbed(model_based(self.scene, kind), 4, payload=(1, 2))
        model, arm = many.forces[0].model, self.scene.linkage
        np.testing.assert_array_equal(model.mass, np.tile(arm.mass, (4, 1)))
        assert (np.asarray(many.linkage.mass)[:, 2] >= arm.mass[2] + 1).all()

    def test_gains_of_computed_torque_have_units_of_their_own(self, tuned):
        scene = model_based(tuned.scene, fj.control.ComputedTorque)
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


def test_a_payload_is_a_point_mass_at_the_tip():
    """Wherever the last link's mass centre is: it adds m J^T J to the mass matrix."""
    arm = fj.Linkage(
        "RRR", length=[0, 1, 1, 0.8], com=[[0.5, 0.1], [0.4, 0], [0.3, -0.2]],
        mass=[1, 1, 2], inertia=[0.1, 0.1, 0.3],
    )  # fmt: skip
    q = np.array([0.3, -0.7, 1.1])
    jacobian = np.asarray(fj.tip_jacobian(arm, q))[:2]
    loaded = fj.tuning.with_payload(arm, 1.5)
    more = fj.mass_matrix(loaded, q) - fj.mass_matrix(arm, q)
    np.testing.assert_allclose(more, 1.5 * jacobian.T @ jacobian, atol=1e-14)
    lift = fj.energy(loaded, q, 0 * q)[1] - fj.energy(arm, q, 0 * q)[1]
    assert lift == pytest.approx(1.5 * 9.81 * fj.tip_position(arm, q)[1])
