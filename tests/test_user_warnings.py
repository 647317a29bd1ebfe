"""Warnings and refusals that name the caller's line, or the way to go."""

import dataclasses
import warnings
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.base.user_warnings import warn, without_warning
from fdof_jax.forces.element import elements_on
from fdof_jax.linkage.coordinates import real_state

ARM = fj.scenes.fig7().linkage  # RPR
ZERO, TWO = np.zeros(3), fj.State(np.zeros((2, 3)), np.zeros(3))
# Of the slide 45 m are no angle.
STOPS = fj.forces.JointStops([-1, -45, -np.inf], [1, 45, 90])
MOVE = fj.references.JointMove([0, 45, 0], [90, 45, 0], fj.references.Travel(1.0))
MOVED = fj.PDController(1.0, 1.0, 1.0, MOVE)
DAMPER = fj.JointDamper([1.0, 1.0, 1.0])


def early(tree):
    """Returns a tree as if made before double precision was set."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), tree)


def solve(linkage, element):
    run = lambda q: fj.simulate(linkage, (q, q), [0, 1], (element,)).q
    jax.eval_shape(run, jnp.zeros(3))


DEGREES = r" .* radians, got -?\d+, .*deg2rad"
WARNED = {
    rf"state0\.q:{DEGREES}": lambda: real_state("state0", ([0, 2, 90], ZERO), ARM),
    f"orientation:{DEGREES}": lambda: fj.inverse_kinematics(ARM, [-1, 1], 30.0),
    f"phase:{DEGREES}": lambda: fj.CircleTask(phase=180),
    f"locked:{DEGREES}": lambda: ARM.replace(locked=[0, 90, 0]),
    f"q:{DEGREES}": lambda: fj.drawing.draw_linkage(ARM, [0, 2, 90]),
    rf"forces\[0\]\.upper:{DEGREES}": lambda: elements_on(ARM, (STOPS,)),
    rf"forces\[0\]\.upper:{DEGREES} ": lambda: fj.sweep(ARM, TWO, [0, 1], (STOPS,)),
    rf"forces\[0\]\.reference\.end:{DEGREES}": lambda: elements_on(ARM, (MOVED,)),
    # Within a transformation, of the line that asks for it
    f"base_angle:{DEGREES}": lambda: jax.vmap(
        lambda q: fj.tip_position(ARM.replace(base_angle=90), q)
    )(jnp.zeros((2, 3))),
    "linkage: .* in float32": lambda: solve(early(ARM), DAMPER),
    r"forces\[0\]: .* in float32": lambda: solve(ARM, early(DAMPER)),
}


@pytest.mark.parametrize("words", WARNED)
def test_a_warning_names_the_argument_and_the_callers_line(words, monkeypatch):
    # Nothing is to be solved.
    monkeypatch.setattr("fdof_jax.batches.sweep.in_chunks", None)
    with pytest.warns(UserWarning, match=f"^{words.strip()}") as caught:
        try:
            WARNED[words]()
        except (ValueError, TypeError):  # out of reach in that direction, or a sweep
            pass
        plt.close("all")
    assert {warning.filename for warning in caught} == {__file__}


def test_other_angles_are_taken_as_they_are():
    for q in ([29.0, 45, 100.3], [-12 * np.pi, 90, 375.0]):  # the slide may be long
        real_state("state0", (q, ZERO), ARM)
    ARM.replace(locked=[45.0, 0, 30])  # of revolute joints [m]
    jax.eval_shape(lambda q: real_state("state0", (q, q), ARM), jnp.full(3, 90.0))


def test_an_assignment_names_the_way():
    for value, name in ((ARM, "mass"), (fj.JointDamper(1.0), "coefficient")):
        way = rf"^{name}: .* its replace\({name}=\.\.\.\)"
        with pytest.raises(dataclasses.FrozenInstanceError, match=way):
            setattr(value, name, 1)
    moved = dataclasses.replace(fj.Point(1, 0.5), along=0.7)
    assert (int(moved.link), float(moved.along)) == (1, 0.7)


def test_a_warning_is_omitted_in_one_thread_alone():
    with warnings.catch_warnings(record=True) as caught, ThreadPoolExecutor(1) as other:
        warnings.simplefilter("always")
        with without_warning("joint 2"):
            warn("joint 2 is here")
            warn("joint 3 is here")
            other.submit(warn, "joint 2 is there").result()
        warn("joint 2 is here again")
    said = [str(one.message) for one in caught]
    assert said == ["joint 3 is here", "joint 2 is there", "joint 2 is here again"]
