"""An arm whose last slide is held moves as one joint less: it keeps its energy."""

import jax
import numpy as np
import pytest

import fdof_jax as fj


@pytest.mark.slow
@pytest.mark.parametrize("joint", [2, 3])
def test_an_arm_with_one_of_two_slides_held_keeps_its_energy(joint):
    arm = fj.Linkage(
        "RPP",
        length=[0, 0.3, 1.2, 0.6],
        com=[[0, 0.5], [0.2, 0.1], [0.4, -0.3]],
        mass=[2.3, 1.4, 0.7],
        inertia=[0.3, 0.5, 0.1],
        locked=[0.3, -0.4, 0.5],
        base_angle=1.3,
    )
    start = fj.State([0.3, -0.2, 0.1], [1.0, 0.5, 0.0])
    # From the start on: the first row is after the blow.
    held = fj.forces.Brake(joint)
    motion = fj.simulate(arm, start, np.linspace(0, 1, 101), (held,))
    energy = jax.vmap(lambda q, qd: sum(fj.energy(arm, q, qd)))(motion.q, motion.qd)
    np.testing.assert_allclose(energy[1:], energy[1], rtol=0, atol=1e-8)
    assert np.ptp(motion.q[:, joint - 1]) == 0
