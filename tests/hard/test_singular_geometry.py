"""Scenes 6 to 9: singular in the paper's form, equal joints, near-parallel axes."""

import warnings

import numpy as np
import pytest
from helpers import SCENES, load, relative_error

import fdof_jax as fj
from hard import scenes as hard

PAPER_SINGULAR = ("hard-masslesstip-RRR", "hard-pointtip-RRP")


@pytest.mark.parametrize("name", PAPER_SINGULAR)
def test_only_the_paper_s_matrix_is_singular(name):
    """A fictitious joint that moves no inertia is a row of zeros in the 6x6 matrix."""
    assert SCENES[name]["paper_masked_singular"]
    r = load(name)
    masked = fj.paper.masked_accelerations(r.linkage, r.x, r.xd, r.force)
    assert relative_error(masked, SCENES[name]["acc0"]) <= 1e-9
    scene = hard.load_common(name)
    assert hard.error(hard.simulate(scene, hard.TIGHT), scene) <= 1e-9


def test_a_slide_through_a_pivot_is_singular_only_in_the_paper_s_matrix():
    """Link 3 has neither length nor moment: its fictitious rotation moves nothing."""
    scene, reference = hard.load("turn-slide-RPR"), hard.REFERENCE["turn-slide-RPR"]
    assert hard.error(hard.simulate(scene, hard.TIGHT), scene) <= 1e-9
    for q, qd, qdd in zip(*(reference[key] for key in ("q", "qd", "qdd"))):
        reduced = fj.forward_dynamics(scene.linkage, q, qd, np.zeros(3))
        assert relative_error(reduced, qdd) <= 1e-9
        masked = fj.paper.masked_accelerations(
            scene.linkage, *fj.paper.to_chain(scene.linkage, q, qd), np.zeros(6)
        )
        turn, slide, last = qdd
        exact = [0, turn, slide, turn, 0, turn + last]
        assert relative_error(masked, exact) <= 1e-9


@pytest.mark.parametrize(
    "name", ["hard-zerolengthRR", "parallel-axes-PPR", "parallel-axes-RPP"]
)
def test_two_joints_that_do_the_same(name):
    """The paper forbids this, but it costs the tip a direction and no accuracy."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = (hard.load_common if name in SCENES else hard.load)(name)
    with pytest.warns(UserWarning, match="the paper's rule") as caught:
        scene.linkage.replace(mass=scene.linkage.mass)
    assert len(caught) == 1
    assert hard.error(hard.simulate(scene, hard.TIGHT), scene) <= 1e-9


@pytest.mark.parametrize("name", ["near-parallel-PPR", "near-parallel-RPP"])
def test_accelerations_of_nearly_parallel_axes(name):
    """Cancellation leaves only a link of 1e-6 kg between slides 1e-3 rad apart."""
    scene, reference = hard.load(name), hard.REFERENCE[name]
    for q, qd, qdd in zip(*(reference[key] for key in ("q", "qd", "qdd"))):
        reduced = fj.forward_dynamics(scene.linkage, q, qd, np.zeros(3))
        assert relative_error(reduced, qdd) <= 1e-9


@pytest.mark.parametrize(
    "name, bound, steps",
    [("near-parallel-PPR", 1e-8, 21), ("near-parallel-RPP", 1e-6, 43)],
)
def test_nearly_parallel_axes(name, bound, steps):
    """A condition of 4e6 enlarges rounding; `steps` are those of heyoka.

    In 5 s the light link of the second arm gets 890 m away, turning at up to 2.6
    rad/s. The slides move by 1.5e7 m per newton (computed with 60 digits). Rounding
    of the tip's weight of 9.81 N moves them by up to 1.4e-8 m, and rounding of the
    centrifugal forces along them, of up to 6 kN, by 7e-6 m.
    """
    scene = hard.load(name)
    motion = hard.simulate(scene, hard.TIGHT)
    assert hard.error(motion, scene) <= bound
    assert motion.stats["num_steps"] <= 5 * steps


def test_a_slide_driven_through_zero():
    """The lever arm of everything that hangs on the slide changes its sign."""
    scene = hard.load("driven-through-0-RPR")
    motion = hard.simulate(scene, hard.TIGHT)
    np.testing.assert_allclose(motion.qd[:, 1], -2, atol=0.1)
    assert motion.q[0, 1] > 0.9 and motion.q[-1, 1] < -0.9
    assert hard.error(motion, scene) <= 1e-9
    slope, *_ = hard.slopes(scene)
    exact = hard.REFERENCE["driven-through-0-RPR"]["dq_dq0"]
    assert hard.largest_error(slope, exact) <= 1e-6
