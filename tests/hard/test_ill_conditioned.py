"""Scenes 3 and 5: mass matrices close to singular, and singular ones."""

import diffrax
import equinox as eqx
import jax
import numpy as np
import pytest

import fdof_jax as fj
from hard.scenes import DRIVEN, OUTPUTS, START, arm, behind_the_door, in_a_batch

TS = np.linspace(0, 2, OUTPUTS)
STILL = np.zeros((3, 3))


@pytest.mark.parametrize(
    "steps", [{}, dict(rtol=1e-13, atol=1e-13)], ids=["default", "tight"]
)
def test_a_tip_of_a_million_tonnes(steps):
    """A condition of 2e11 leaves five digits.

    Rounding determines the error estimate. For a controller of one's own see
    test_mass_ratios.py.
    """
    heavy = arm(mass=[1, 1, 1e9])
    solution = fj.simulate(heavy, START, TS, **steps)
    assert solution.stats["num_steps"] < 10_000
    error = np.abs(solution.q - np.array(DRIVEN["heavy-tip-1e9"]["q"])).max()
    assert error <= 1e-3


@pytest.mark.parametrize("how", ["gradient", "Dopri8", "Kvaerno5"])
def test_other_solvers_are_stopped_too(how):
    """Only the default solver itself checks the conditioning."""
    heavy = arm(mass=[1, 1, 1e12])
    if how == "gradient":
        motion, *_ = behind_the_door(heavy, START.q, TS)
    else:
        solver = getattr(diffrax, how)()
        motion = fj.simulate(heavy, START, TS, solver=solver, throw=False)
    assert motion.outcome == "ill-conditioned"
    assert motion.stats["num_steps"] < 100


@pytest.mark.parametrize("topology", ["RRR", "RPR", "PRR", "PPR"])
def test_a_last_link_without_inertia_is_refused(topology):
    """The acceleration of its joint is undetermined in every configuration."""
    with pytest.raises(ValueError, match=r"joint 3 \(revolute\).*inertia of link 3"):
        arm(topology, com=[[0.5, 0], [0.5, 0], [0, 0]], inertia=[1 / 12, 1 / 12, 0])


def test_a_singular_member_is_named_and_harms_no_other():
    """Under a transformation that member's values cannot be checked beforehand."""
    usual = arm()
    massless = eqx.tree_at(
        lambda a: (a.com, a.inertia),
        usual,
        (usual.com.at[2].set(0), usual.inertia.at[2].set(0)),
    )
    q = START.q + np.array([[0.0], [0.1], [0.2]])

    def motions(*arms):
        stacked = jax.tree.map(lambda *a: np.stack(a), *arms)
        return in_a_batch(stacked, q, STILL, TS)

    broken = motions(usual, massless, usual)
    clean = motions(usual, usual, usual)
    assert clean.outcome[:3].tolist() == ["successful"] * 3
    named = ["successful", "ill-conditioned", "successful"]
    assert broken.outcome[:3].tolist() == named
    assert broken.stats["num_steps"][1] < 100
    assert np.isnan(broken.q[1, 1:]).all()
    for member in (0, 2):
        np.testing.assert_array_equal(broken.q[member], clean.q[member])
        np.testing.assert_array_equal(broken.qd[member], clean.qd[member])
