"""Gain tuning raises errors for scenes and settings that it cannot tune."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_limits import step

import fdof_jax as fj
from fdof_jax import scenes, tuning
from fdof_jax.tuning.losses import tip_errors

FIG7, FIG5 = scenes.fig7(), scenes.fig5()
RRR = scenes.circle_scenes()["RRR"]
ONES, PRICED = np.ones((2, 3)), tuning.Tracking(effort=1.0)
LAG = fj.control.FirstOrderLag(fj.JointEffort([0.0]), 0.1)
WEAK = step(limit=0.1)
PUSHED = WEAK._replace(forces=(*WEAK.forces, fj.JointEffort([1.0])))
LATE = WEAK._replace(forces=(*WEAK.forces, LAG))
DAMPED = RRR._replace(forces=(*RRR.forces, fj.JointDamper(1.0)))


def with_limit(scene, limit):
    values = jnp.broadcast_to(jnp.asarray(limit, float), scene.forces[0].kp.shape)
    return eqx.tree_at(lambda scene: scene.forces[0].limit, scene, values)


def within(scene, loss=tuning.joint_errors, **limits):
    return tuning.tune_within(scene, tuning.Limits(**limits), loss=loss)


FREE, NO_FORCE = with_limit(FIG7, np.inf), with_limit(FIG7, [0, 1, 1])
MIXED = tuning.stacked([FIG7, FREE])

CASES = {
    fj.tune: [
        (FIG7, dict(factor=1.0), "factor"),
        (FIG7, dict(factor="4"), "factor"),
        (FIG7, dict(factor=2.0, bounds=(ONES, ONES)), "factor"),
        (FIG7, dict(method="adam"), "method: expected one of"),
        (FIG7, dict(max_steps=0), "max_steps"),
        (FIG7, dict(max_steps=2.5), "max_steps"),
        (FIG7, dict(max_steps=True), "max_steps"),
        (FIG7, dict(starts=0), "starts"),
        (FIG7, dict(seed=-1), "seed"),
        (FIG7, dict(report=3), "report"),
        (FIG7, dict(over="best"), "over"),
        (FIG7, dict(over="worst"), "over: expected an ensemble"),
        (FIG7, dict(ensemble=3), "ensemble"),
        (FIG7, dict(ensemble=FIG7), "ensemble: expected scenes stacked"),
        (FIG7, dict(ensemble=tuning.stacked([RRR])), r"ensemble\[0\]: expected joints"),
        (FIG7, dict(loss=3), "loss"),
        (FIG7, dict(loss=tuning.Tracking), "loss: expected a callable"),
        (FREE, dict(loss=PRICED), "loss: expected finite limits"),
        (FIG7, dict(loss=PRICED, ensemble=MIXED), "loss: expected finite limits"),
        (NO_FORCE, dict(loss=PRICED), "loss: expected finite limits"),
        (FIG7, dict(bounds=(1, 2, 3)), "bounds"),
        (FIG7, dict(bounds=(ONES, np.ones((2, 2)))), "bounds"),
        (FIG7, dict(bounds=(9 * ONES, ONES)), "bounds: expected the scene's"),
        (FIG7, dict(bounds=(ONES, 2 * ONES)), "bounds"),
        (FIG7, dict(bounds=(0 * ONES, 1e9 * ONES)), "bounds"),
        (FIG5, {}, "scene: expected exactly one PDController"),
        (5, {}, "scene"),
        (FIG7._replace(t1=-1.0), {}, r"scene\.t1"),
        (FIG7._replace(t1=np.nan), {}, r"scene\.t1"),
        (FIG7._replace(t1="a"), {}, r"scene\.t1"),
        (FIG7._replace(linkage=None), {}, "linkage"),
        (FIG7._replace(forces=FIG7.forces[0]), {}, r"scene\.forces"),
    ],
    tuning.stacked: [
        (RRR, {}, "scenes: expected a list"),
        ([FIG7, FIG5], {}, r"scenes\[1\]: expected one like"),
        ([RRR, DAMPED], {}, r"scenes\[1\]: expected one like scenes\[0\]"),
    ],
    tuning.tune_within: [(step(), dict(limits=0.1), "limits: expected a Limits")],
    within: [
        (step(), dict(loss=tip_errors), "its controller to track a task with a `tip`"),
        (step(), dict(overshoot=[0.1, 0.1]), "limits.overshoot: .* for 1 joints"),
        (step(), dict(overshoot=-1), "overshoot"),
        (step(), dict(effort=0), "effort"),
        (step(), dict(modulus_margin=np.inf), "modulus_margin"),
        (PUSHED, dict(overshoot=0.1), "scene: expected an equilibrium"),
        (LATE, dict(overshoot=0.1), "forces: expected elements without a state"),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "call, scene, keywords, message",
    [(call, *case) for call, cases in CASES.items() for case in cases],
)
def test_malformed_arguments(call, scene, keywords, message):
    with pytest.raises(ValueError, match=message):
        call(scene, **keywords)


def test_tuning_is_not_for_transformations():
    with pytest.raises(ValueError, match="scene: expected known values"):
        jax.jit(lambda t1: fj.tune(FIG7._replace(t1=t1)).gains)(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("value", ["a", None, 1j, (1.0, 2.0, "b")])
def test_a_loss_that_is_no_number_is_refused(value):
    with pytest.raises(ValueError, match=r"loss\(scene, solution\): expected a"):
        fj.tune(FIG7, loss=lambda scene, solution: value)
