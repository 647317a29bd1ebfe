"""Gain tuning raises errors for scenes and settings that it cannot tune."""

import jax
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax import scenes
from fdof_jax.tuning import losses


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        (dict(factor=1.0), "factor"),
        (dict(factor="4"), "factor"),
        (dict(method="adam"), "method: expected one of"),
        (dict(max_steps=0), "max_steps"),
        (dict(max_steps=2.5), "max_steps"),
        (dict(max_steps=True), "max_steps"),
        (dict(starts=0), "starts"),
        (dict(seed=-1), "seed"),
        (dict(over="best"), "over"),
        (dict(over="worst"), "over: expected an ensemble"),
        (dict(factor=2.0, bounds=(np.ones((2, 3)), np.ones((2, 3)))), "factor"),
        (dict(report=3), "report"),
        (dict(ensemble=3), "ensemble"),
        (dict(loss=3), "loss"),
        (dict(loss=losses.Tracking), "loss: expected a callable"),
        (dict(bounds=(1, 2, 3)), "bounds"),
        (dict(bounds=(np.ones((2, 3)), np.ones((2, 2)))), "bounds"),
        (dict(bounds=(np.full((2, 3), 9), np.ones((2, 3)))), "bounds: expected the sc"),
        (dict(bounds=(np.ones((2, 3)), 2 * np.ones((2, 3)))), "bounds"),
        (dict(bounds=(np.zeros((2, 3)), np.full((2, 3), 1e9))), "bounds"),
    ],
)
def test_malformed_arguments(keywords, message):
    with pytest.raises(ValueError, match=message):
        fj.tune(scenes.fig7(), **keywords)


@pytest.mark.parametrize(
    "scene",
    [
        scenes.fig5(),
        5,
        None,
        scenes.fig7()._replace(t1=-1.0),
        scenes.fig7()._replace(t1=np.nan),
        scenes.fig7()._replace(t1="a"),
        scenes.fig7()._replace(linkage=None),
        scenes.fig7()._replace(forces=scenes.fig7().forces[0]),
    ],
)
def test_malformed_scenes(scene):
    """Covers values that are no scene, and scenes without exactly one controller."""
    with pytest.raises(ValueError, match="scene|linkage"):
        fj.tune(scene)


def test_tuning_is_not_for_transformations():
    scene = scenes.fig7()
    with pytest.raises(ValueError, match="scene: expected known values"):
        jax.jit(lambda t1: fj.tune(scene._replace(t1=t1)).gains)(1.0)


@pytest.mark.parametrize("value", ["a", None, 1j, (1.0, 2.0, "b")])
def test_a_loss_that_is_no_number_is_refused(value):
    with pytest.raises(ValueError, match=r"loss\(scene, solution\): expected a"):
        fj.tune(scenes.fig7(), loss=lambda scene, solution: value)


def test_keywords_of_tune_are_those_of_its_relatives():
    scene = scenes.fig7()
    with pytest.raises(TypeError, match="step: expected a keyword among factor, "):
        fj.tuning.tune_each([scene], step=3)
    with pytest.raises(TypeError, match="ensemble: expected a keyword"):
        fj.tuning.tune_each([scene], ensemble=scene)
    with pytest.raises(TypeError, match="loss: expected a keyword"):
        fj.tuning.trade_off(scene, [0.0], loss=losses.tip_errors)
