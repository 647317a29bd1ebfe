"""Joints that bounce together come to rest, and energy is accounted for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj


def arms(count, rng):
    """Arms of two joints in random poses; gravity draws them to their stops."""
    rows = [
        fj.Linkage(
            str(rng.choice(["RR", "PR", "RP"])),
            length=[0, *rng.uniform(0.3, 1.2, 2)],
            com=rng.uniform(-0.3, 0.6, (2, 2)),
            mass=rng.uniform(0.5, 3, 2),
            inertia=rng.uniform(0.05, 0.5, 2),
            base_angle=rng.uniform(-3, 3),
        )
        for _ in range(count)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


@pytest.mark.slow
def test_two_joints_bounce_to_rest():
    linkages = arms(60, np.random.default_rng(0))
    stops = fj.forces.HardStops(-0.5, 0.5, restitution=0.5)

    def motion(arm):
        start = fj.State([0.0, 0.0], [0.0, 0.0])
        return fj.simulate(arm, start, [0, 4.0], (stops,), throw=False)

    def energy(arm, q, qd):
        return sum(fj.energy(arm, q, qd))

    found = jax.vmap(motion)(linkages)
    assert (found.outcome == "successful").all()
    energies = [
        jax.vmap(energy)(linkages, found.q[:, k], found.qd[:, k]) for k in (0, 1)
    ]
    missing = energies[0] - energies[1] - found.taken[:, 1]
    np.testing.assert_allclose(missing, 0, atol=1e-7)
    assert (found.modes[:, 1] > 0).all(axis=1).any()  # both rest


def test_joints_whose_blows_throw_each_other_at_their_stops():
    """They hit them in turn, at times that come ever closer to one instant."""
    arm = fj.Linkage(
        "RRR", length=[0] + [0.4] * 3, com=[[0.2, 0.02]] * 3, mass=[1] * 3,
        inertia=[0.02] * 3,
    )  # fmt: skip
    start = fj.State([0.1884, -0.1111, -0.3649], [2.6621, -1.8042, 0.073])
    stops = fj.forces.HardStops(
        [-0.8464, -1.4442, -0.6227], [0.8494, 1.2355, 1.0909],
        restitution=[0.432, 0.0574, 0.2778],
    )  # fmt: skip
    motion = fj.simulate(arm, start, [0, 1.0], (stops,))
    energy = [sum(fj.energy(arm, motion.q[k], motion.qd[k])) for k in (0, 1)]
    np.testing.assert_allclose(energy[0] - energy[1], motion.taken[1], atol=1e-8)
