"""A scene is accepted whole in place of its linkage, state and forces."""

import jax
import numpy as np
import pytest
from elements import SHORT

import fdof_jax as fj

SCENE = fj.scenes.fig3()
ARM, START, FORCES, _ = SCENE
TS = np.linspace(0, 0.05, 6)
OTHER = fj.State(np.array([0.3, 2.0, 0.1]), np.array([0.1, 0.2, 0.3]))
MOTION = fj.Solution(TS, np.full((6, 3), 0.7), np.ones((6, 3)), {}, None)


MANY = fj.tuning.stacked([SCENE, SCENE._replace(state0=OTHER)])
MEMBERS = MANY.linkage, MANY.state0, TS, MANY.forces


@pytest.mark.slow
@pytest.mark.parametrize(
    "function, whole, parts, options",
    [
        (fj.simulate, (SCENE, TS), (ARM, START, TS, FORCES), SHORT),
        (fj.sweep, (MANY, TS), MEMBERS, dict(forces_axes=0, **SHORT)),
        (fj.joint_efforts, (SCENE, MOTION), (ARM, FORCES, MOTION), {}),
        (fj.joint_reactions, (SCENE, MOTION), (ARM, FORCES, MOTION), {}),
        (fj.linearize, (SCENE,), (ARM, START, FORCES), dict(t=0.3)),
        (fj.linearize, (SCENE, OTHER), (ARM, OTHER, FORCES), dict(t=0.3)),
    ],
)
def test_a_scene_stands_for_its_parts(function, whole, parts, options):
    found, expected = function(*whole, **options), function(*parts, **options)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    if function is fj.simulate:
        by_keyword = function(SCENE, ts=TS, **options)
        jax.tree.map(np.testing.assert_array_equal, by_keyword, expected)


@pytest.mark.parametrize(
    "name, call",
    [
        ("forces", lambda: fj.simulate(SCENE, TS, forces=FORCES)),
        ("state0", lambda: fj.simulate(SCENE, ts=TS, state0=START)),
        ("linkage", lambda: fj.sweep(SCENE, TS, linkage=ARM)),
        ("scene", lambda: fj.simulate(SCENE, TS, FORCES)),
        ("scene", lambda: fj.sweep(SCENE, START, TS)),
        ("scene", lambda: fj.joint_efforts(SCENE, FORCES, MOTION)),
        ("scene", lambda: fj.joint_reactions(SCENE, FORCES, MOTION)),
        ("forces", lambda: fj.linearize(SCENE, OTHER, forces=FORCES)),
    ],
)
def test_a_scene_beside_its_parts_is_refused(name, call):
    with pytest.raises(ValueError, match=rf"(?s)^{name}: expected .* Scene.*, got "):
        call()


def test_arguments_beside_a_scene_are_those_of_the_function():
    with pytest.raises(TypeError, match="missing .* 'ts'"):
        fj.simulate(SCENE)
    with pytest.raises(TypeError, match="multiple values .* 'ts'"):
        fj.simulate(SCENE, TS, ts=TS)
