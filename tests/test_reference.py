"""The library compared with reference scenes of 50 digits."""

import diffrax
import jax
import numpy as np
import pytest
from helpers import SCENES, load, real_part, relative_error, to_joint

import fdof_jax as fj

ALL = sorted(SCENES)
# Condition of the accelerations or of the motion itself: mass ratio 1e6, inertias of
# 1e-9, and angular velocities of 1e3 rad/s.
ILL_CONDITIONED = {"hard-massratio-heavybase", "hard-I1e-9-all", "hard-spin1e3"}


@pytest.mark.parametrize("name", ALL)
def test_an_instant(name):
    scene, r = SCENES[name], load(name)
    # Exact accelerations are subtracted, as the printed doubles would cancel.
    qdd = to_joint(scene, [float(a) for a in scene["acc0_str"]])
    chain = r.linkage, r.x, r.xd, r.force
    constraint = fj.paper.constraint_forces(*chain)
    kinetic, potential = fj.energy(r.linkage, *r.state0)
    bound = 5e-11 if name in ILL_CONDITIONED else 1e-11
    for found, exact in (
        (fj.paper.masked_accelerations(*chain), scene["acc0"]),
        (fj.forward_dynamics(r.linkage, *r.state0, r.tau), qdd),
        (constraint, scene["con0"]),
        (kinetic, scene["T0"]),
        (potential, scene["V0"]),
    ):
        assert relative_error(found, exact) <= bound
    assert (real_part(scene, constraint) == 0).all()
    # What acts on fictitious joints only loads them.
    fictitious = np.asarray(r.linkage.ef) == 0
    more = fj.paper.constraint_forces(*chain[:3], r.force + 7.0 * fictitious)
    assert relative_error(more, constraint - 7.0 * fictitious) <= 1e-10


def solve(name, rtol=1e-12, atol=1e-12):
    """Returns chain coordinates, rates and energies at the scene's output times."""
    scene, r = SCENES[name], load(name)
    times = [state["t"] for state in scene["states"]]
    solution = fj.simulate(
        r.linkage,
        r.state0,
        [0, *times],
        r.forces,
        # Steps end at the output times, which excludes the error of interpolation.
        stepsize_controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=rtol, atol=atol),
            # Of one length, for one program.
            step_ts=np.array([*times, 100.0, 101.0, 102.0][:5]),
        ),
    )
    chain = jax.vmap(fj.paper.to_chain, in_axes=(None, 0, 0))
    x, xd = chain(r.linkage, solution.q, solution.qd)
    energies = jax.vmap(fj.energy, in_axes=(None, 0, 0))
    return x[1:], xd[1:], sum(energies(r.linkage, solution.q, solution.qd))[1:]


@pytest.mark.parametrize("name", [n for n in ALL if n != "hard-inverted"])
def test_states(name):
    for key, found in zip("qvE", solve(name)):
        for value, state in zip(found, SCENES[name]["states"]):
            assert relative_error(value, state[key]) <= 1e-9


def test_inverted_pendulum_falls_at_the_right_rate():
    """The deviation from upright grows from 6e-17, the rounding error of pi/2."""
    states = SCENES["hard-inverted"]["states"]
    x, xd, _ = solve("hard-inverted", rtol=1e-12, atol=1e-16)
    deviation = np.asarray(x)[:, 1::2] - np.pi / 2
    expected = np.array([s["q"] for s in states])[:, 1::2] - np.pi / 2
    # The file holds absolute angles: 1e-16 of rounding in deviations of 1e-15 to 1e-11.
    np.testing.assert_allclose(deviation, expected, rtol=0.01, atol=4e-16)
    rates = np.array([s["v"] for s in states])[:, 1::2]
    np.testing.assert_allclose(np.asarray(xd)[:, 1::2], rates, rtol=0.01, atol=1e-20)
