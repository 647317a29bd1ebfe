"""Scenes 3 and 5: mass matrices close to singular, and singular ones."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from hard.scenes import DRIVEN, OUTPUTS, START, TIGHT, arm, behind_the_door

TS = np.linspace(0, 2, OUTPUTS)


@pytest.mark.parametrize("steps", [None, TIGHT], ids=["default", "tight"])
def test_a_tip_of_a_million_tonnes(steps):
    """A condition of 2e11 leaves five digits.

    Rounding, not the method, determines the error estimate.
    """
    solution = fj.simulate(
        arm(mass=[1, 1, 1e9]),
        START,
        TS,
        stepsize_controller=steps,
        max_steps=10_000,
    )
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
    com = jnp.stack([usual.com] * 3).at[1, 2].set(0)
    inertia = jnp.stack([usual.inertia] * 3).at[1, 2].set(0)
    q = START.q + np.array([[0.0], [0.1], [0.2]])

    @jax.jit
    def motions(com, inertia):
        def linkage(com, inertia):
            return eqx.tree_at(lambda a: (a.com, a.inertia), usual, (com, inertia))

        return jax.vmap(
            lambda com, inertia, q: fj.simulate(
                linkage(com, inertia), fj.State(q, START.qd), TS, throw=False
            )
        )(com, inertia, q)

    broken = motions(com, inertia)
    clean = motions(com.at[1].set(usual.com), inertia.at[1].set(usual.inertia))
    assert clean.outcome.tolist() == ["successful"] * 3
    assert broken.outcome.tolist() == ["successful", "ill-conditioned", "successful"]
    assert broken.stats["num_steps"][1] < 100
    assert np.isnan(broken.q[1, 1:]).all()
    for member in (0, 2):
        np.testing.assert_array_equal(broken.q[member], clean.q[member])
        np.testing.assert_array_equal(broken.qd[member], clean.qd[member])
