"""Rounding errors free no joint that is held, and derivatives know what is held."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.forces import Brake, HardStops, JointFriction, Payload

inf = np.inf
SLIDE = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], gravity=0.0)
CROSSED = fj.Linkage(
    "PP", length=[0, 0, 0], com=[[0, 0]] * 2, mass=[1, 1], inertia=[1, 1],
    locked=[np.pi / 2, 0], gravity=0.0,
)  # fmt: skip


def crossed(linkage=CROSSED, rate=0.0, brake=9.0, mass=0.0, stop=inf, load=1.5):
    """The second of two slides moves; the first one is at rest, under a load."""
    forces = (
        JointFriction([1.0, 0.0], static=[2.0, 0.0]), fj.JointEffort([load, 0.0]),
        Brake(2, brake, 9.5), Payload(fj.Point(2), mass, begin=1.0),
        HardStops(-inf, [inf, stop], restitution=0.5),
    )  # fmt: skip
    return fj.simulate(linkage, fj.State([0.0, 0.0], [rate, 1.0]), [0, 2.0], forces)


@pytest.mark.slow
def test_a_rounding_error_frees_no_joint():
    """Inertia couples the slides by 6e-17, as pi / 2 is rounded."""
    assert 0 < fj.mass_matrix(CROSSED, [0.0, 0.0])[0, 1] < 1e-15
    for case in (
        dict(brake=0.7), dict(mass=1e-9), dict(mass=0.5), dict(stop=0.5),
        dict(rate=1e-17), dict(rate=-1e-14),
    ):  # fmt: skip
        motion = crossed(**case)
        assert motion.q[-1, 0] == 0 and motion.qd[-1, 0] == 0, case
        assert (motion.modes[:, 0] == 1).all(), case
        assert motion.events.count == sum(k in case for k in ("brake", "stop")), case
    # What is no rounding error frees it: a rate, a load, a blow of slides that are not
    # quite perpendicular.
    tilted = CROSSED.replace(locked=[np.pi / 2 - 1e-6, 0])
    for case, end in (
        (dict(rate=1e-9), 2e-9 + 0.5), (dict(load=2.1), 1.1),
        (dict(linkage=tilted, brake=0.7), 0.125 * 1.3**2),
    ):  # fmt: skip
        np.testing.assert_allclose(crossed(**case).q[-1, 0], end, rtol=1e-5)


@pytest.mark.slow
def test_derivatives_of_a_rate_that_counts_as_zero():
    """Where the joint is held they are 0; where it slides off, those of its start."""

    def end(rate, load):
        friction = JointFriction(1.0, static=2.0)
        start = fj.State(jnp.zeros(1), jnp.stack([rate]))
        effort = fj.JointEffort(jnp.stack([load]))
        forward = diffrax.ForwardMode()
        forces = friction, effort
        motion = fj.simulate(SLIDE, start, [0, 2.0], forces, adjoint=forward)
        return jnp.stack([motion.q[-1, 0], motion.qd[-1, 0]])

    slopes = jax.jit(jax.jacfwd(end), **LOOPS)
    np.testing.assert_array_equal(slopes(1e-14, 1.5), 0)
    np.testing.assert_allclose(slopes(1e-14, 2.5), [2, 1], rtol=1e-12)
