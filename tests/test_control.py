"""Controllers: the saturated PD law, feed-forward, computed torque, gains."""

import equinox as eqx
import jax
import numpy as np
import pytest
from elements import MOVE
from helpers import random_linkage

import fdof_jax as fj
from fdof_jax.tuning.losses import with_gains

TS = np.zeros(1)
PENDULUM = fj.Linkage(
    "R", length=[0, 1], com=[[0.6, 0.2]], mass=[2], inertia=[0.3], gravity=9.81
)
WITH_MODEL = fj.control.GravityFeedforward, fj.control.ComputedTorque


class Stand(fj.references.Reference):
    target: fj.Values = fj.field(unit="m or rad")

    def __call__(self, t, linkage):
        return self.target, 0 * self.target


def arm(topology, seed=0):
    rng = np.random.default_rng(seed)
    return random_linkage(topology, rng), rng.uniform(-1, 1, 3)


def pd_at(q, kp, kd):
    full = lambda value: np.broadcast_to(value, len(q)).astype(float)
    return fj.PDController(full(kp), full(kd), full(np.inf), Stand(q))


def poles(linkage, q, *forces):
    A, _ = fj.linearize(linkage, fj.State(q, 0 * q), forces)
    return np.linalg.eigvals(A)


@pytest.mark.parametrize("limit", [[3.0, 4.0, 5.0], [1e9, 0.0, np.inf]])
def test_the_controller_is_the_clipped_sum_of_both_errors(limit):
    """Gains have an effect below the limit alone, and the limit beyond it."""
    rng, (linkage, _) = np.random.default_rng(0), arm("RPR")
    (q_ref, qd_ref), (kp, kd) = rng.normal(size=(2, 3)), rng.uniform(0, 10, (2, 3))
    controller = fj.PDController(kp, kd, limit, lambda t, k: (q_ref * t, qd_ref))
    effort = lambda c, q, qd: c(2.0, q, qd, linkage)
    slopes_at = eqx.filter_jit(eqx.filter_jacfwd(effort))
    for q, qd in rng.normal(size=(20, 2, 3)):
        errors = 2 * q_ref - q, qd_ref - qd
        demand = kp * errors[0] + kd * errors[1]
        limited = np.maximum(-np.array(limit), np.minimum(limit, demand))
        np.testing.assert_allclose(controller.demand(2.0, q, qd, linkage), demand)
        np.testing.assert_allclose(effort(controller, q, qd), limited)
        held, slopes = np.abs(demand) > limit, slopes_at(controller, q, qd)
        for slope, factor in zip((slopes.kp, slopes.kd), errors):
            np.testing.assert_allclose(slope, np.diag(np.where(held, 0, factor)))
        ends = np.diag(np.where(held, np.sign(demand), 0))
        np.testing.assert_allclose(slopes.limit, ends)


@jax.jit
def demanded(controller, q, qd, linkage):
    return controller.demand(0.4, q, qd, linkage), controller(0.4, q, qd, linkage)


@pytest.mark.parametrize("topology", fj.TOPOLOGIES)
def test_models_hold_the_weight_or_have_the_inverse_dynamics(topology):
    """By default of the arm, otherwise of what the controller believes."""
    rng, h = np.random.default_rng(3), 1e-6
    linkage, (q, qd) = random_linkage(topology, rng), rng.uniform(-2, 2, (2, 3))
    heavier = eqx.tree_at(lambda k: k.mass, linkage, 1.3 * linkage.mass)
    (_, ahead), (q_ref, qd_ref), (_, behind) = (
        MOVE(t, linkage) for t in (0.4 + h, 0.4, 0.4 - h)
    )
    errors = 8 * (q_ref - q) + 5 * (qd_ref - qd)
    for model, believed in (None, linkage), (heavier, heavier):
        weight = fj.analysis.holding_efforts(believed, q)
        qdd = (ahead - behind) / (2 * h) + errors
        torque = fj.inverse_dynamics(believed, q, qd, qdd)
        for kind, expected in zip(WITH_MODEL, (errors + weight, torque)):
            limit = np.abs(expected) * [0.5, 2, 0.9]  # of the whole effort
            controller = kind(8.0, 5.0, limit, MOVE, model)
            found, limited = demanded(controller, q, qd, linkage)
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)
            clipped = np.clip(expected, -limit, limit)
            np.testing.assert_allclose(limited, clipped, atol=1e-8)


@pytest.mark.parametrize("kind", WITH_MODEL)
def test_models_are_of_the_arms_topology_and_gains_are_tuned(kind):
    model, other = arm("RPR")[0], arm("RRR")[0]
    controller = kind(8.0, 5.0, np.inf, MOVE, model)
    assert controller.fits(arm("RPR", 1)[0], TS) and not controller.fits(other, TS)
    scene = fj.Scene(model, fj.State(*np.zeros((2, 3))), (controller,), 1.0)
    (tuned,) = with_gains(scene, np.ones((2, 3))).forces
    assert isinstance(tuned, kind)
    np.testing.assert_array_equal([tuned.kp, tuned.kd], 1)


@pytest.mark.slow
def test_a_joint_that_moves_alone_has_the_frequency_and_the_damping():
    linkage, q = arm("RRR")
    linkage = linkage.replace(gravity=0, locked=0)
    frequency, ratio = np.array([3.0, 5.0, 8.0]), np.array([0.2, 0.7, 1.0])
    gains = fj.control.gains_from_frequency(linkage, q, frequency, ratio)
    alone = linkage.replace(topology="FRF", locked=q)
    found = poles(alone, q, pd_at(q, *gains))
    expected = np.roots([1, 2 * 0.7 * 5, 25])
    found = found[np.abs(found) > 1e-6]  # without those of the fixed pairs
    np.testing.assert_allclose(np.poly(found), np.poly(expected), rtol=1e-9)
    fixed = fj.control.gains_from_frequency(alone, q, frequency, ratio)
    np.testing.assert_allclose(fixed, np.eye(3)[1] * gains, rtol=1e-12)
    # Masses of elements count.
    more = np.array([1.0, 2.0, 3.0])
    forces = (fj.forces.Armature(more),)
    geared = fj.control.gains_from_frequency(linkage, q, frequency, ratio, forces)
    added = np.subtract(geared, gains)
    expected = frequency**2 * more, 2 * ratio * frequency * more
    np.testing.assert_allclose(added, expected, rtol=1e-12)
