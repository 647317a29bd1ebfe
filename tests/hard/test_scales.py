"""Scenes 21 and 22: sizes other than a metre, other units, and many turns."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import fdof_jax as fj
from hard.scenes import START, USUAL, arm, without_turns

TS = np.linspace(0, 5, 11)


@eqx.filter_jit
def in_units(linkage, state0, ts, unit_q, unit_qd):
    """Returns a motion whose errors are measured in a unit per coordinate."""

    def norm(error):
        q, qd, *own = error
        return optimistix.rms_norm(
            (jnp.stack(q) / unit_q, jnp.stack(qd) / unit_qd, own)
        )

    steps = diffrax.PIDController(rtol=1e-11, atol=1e-11, norm=norm)
    return fj.simulate(linkage, state0, ts, stepsize_controller=steps)


def scaled(topology, size, mass, gravity=9.81):
    """Returns the usual arm in other units, and factors of its joints and time."""
    linkage = arm(
        topology,
        length=np.array(USUAL["length"]) * size,
        com=np.array(USUAL["com"]) * size,
        mass=[mass] * 3,
        inertia=[mass * size**2 / 12] * 3,
        gravity=gravity,
    )
    unit = np.array([1 if joint == "R" else size for joint in topology])
    return linkage, unit, np.sqrt(size * 9.81 / gravity)


@pytest.mark.parametrize("topology", ["RRR", "RPR"])
def test_sizes_and_units_do_not_matter(topology):
    """An absolute tolerance of 1e-11 m depends on the size of the arm.

    It is 1e-8 of an arm of 1 mm, and near rounding for one of 1 km. The defaults serve
    both, and so do units per coordinate.
    """
    worlds = {
        "1 mm": scaled(topology, 1e-3, 1e-3),
        "1 km, 1e9 kg": scaled(topology, 1e3, 1e9),
        "mm, g": scaled(topology, 1e3, 1e3, gravity=9810.0),
    }
    usual = fj.simulate(arm(topology), START, TS)
    for name, (linkage, unit, time) in worlds.items():
        start = fj.State(START.q * unit, START.qd)
        motions = (
            fj.simulate(linkage, start, TS * time),
            in_units(linkage, start, TS * time, unit, unit / time),
        )
        for motion in motions:
            assert np.abs(motion.q / unit[None] - usual.q).max() <= 5e-10, name
            steps = motion.stats["num_steps"] / usual.stats["num_steps"]
            assert 0.5 < steps < 2, name


@pytest.mark.parametrize("joints", [[1, 0, 0], [1, 1, 1]], ids=["first", "all"])
@pytest.mark.parametrize("turns", [1e6, 1e8])
def test_turns_do_not_matter(turns, joints):
    """Arguments of sine and cosine, and sums of angles, lose ten digits.

    A tolerance relative to the angle means nothing. The result keeps the turns, so
    a position in it is rounded by up to 6e-8 rad after 1e8 turns: the bound is 1e-9
    or an ulp of it.
    """
    offset = START.q + 2 * np.pi * turns * np.array(joints)
    kept = without_turns(offset)
    plain = fj.simulate(arm(), fj.State(kept, START.qd), TS)
    far = fj.simulate(arm(), fj.State(offset, START.qd), TS)
    error = np.abs((far.q - offset[None]) - (plain.q - kept[None])).max(axis=0)
    assert (error <= np.maximum(1e-9, np.spacing(np.abs(offset)))).all()
    assert np.abs(far.qd - plain.qd).max() <= 1e-9 * np.abs(plain.qd).max()
    steps = int(plain.stats["num_steps"])
    assert abs(int(far.stats["num_steps"]) - steps) <= 0.01 * steps
