"""Chains of one to eight pairs of joints: equations, energies and kinematics."""

import itertools

import chains
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.mechanics.kinematics import mass_center_velocities


def cases(pairs, count=12):
    """Yields topologies of so many pairs, chains, and random q, qd and tau.

    Arms of three pairs are compared with MuJoCo in test_mjcf.py.
    """
    rng = np.random.default_rng(pairs)
    for _ in range(count):
        topology = chains.random_topology(pairs, rng)
        chain = chains.random_chain(topology, rng)
        yield topology, chain, rng.normal(size=(3, pairs)) * [[1], [2], [5]]


@jax.jit  # one program for all chains of a length
def everything(chain, q, qd, tau):
    qdd = fj.forward_dynamics(chain, q, qd, tau)
    return dict(
        qdd=qdd,
        tau=fj.inverse_dynamics(chain, q, qd, qdd),
        bias=fj.bias_force(chain, q, qd),
        matrix=fj.mass_matrix(chain, q),
        energy=fj.energy(chain, q, qd),
        joints=fj.joint_positions(chain, q),
        centers=fj.mass_centers(chain, q),
        rates=mass_center_velocities(chain, q, qd),
        center_rates=jax.jvp(lambda q: fj.mass_centers(chain, q), (q,), (qd,))[1],
        tip=fj.tip_position(chain, q),
        velocity=jax.jvp(lambda q: fj.tip_position(chain, q), (q,), (qd,))[1],
        jacobian=fj.tip_jacobian(chain, q),
    )


@pytest.mark.slow
@pytest.mark.parametrize("pairs", [1, 2, 5, 8])
def test_motion_energy_and_kinematics_equal_mujoco(pairs):
    for topology, chain, (q, qd, tau) in cases(pairs):
        found = jax.tree.map(np.asarray, everything(chain, q, qd, tau))
        real = chains.moving(topology)
        exported = mujoco.MjModel.from_xml_string(fj.to_mjcf(chain))
        names = [exported.joint(k).name for k in range(exported.njnt)]
        assert names == [f"joint{k + 1}" for k in np.flatnonzero(real)]
        models = (exported, mujoco.MjData(exported)), chains.in_mujoco(topology, chain)
        for model, data in models:
            data.qpos, data.qvel, data.qfrc_applied = q[real], qd[real], tau[real]
            mujoco.mj_forward(model, data)
            error = np.abs(found["qdd"][real] - data.qacc).max()
            assert error <= 1e-10 * (1 + np.abs(data.qacc).max()), topology
            tip = data.site("tip").xpos[:2]
            np.testing.assert_allclose(found["tip"], tip, atol=1e-12)
        assert (found["qdd"][~real] == 0).all()
        kinetic, potential = found["energy"]
        np.testing.assert_allclose(
            [potential, kinetic], data.energy, rtol=1e-11, atol=1e-11
        )
        np.testing.assert_allclose(found["centers"], data.xipos[2:, :2], atol=1e-12)
        np.testing.assert_allclose(found["joints"], data.xpos[2:, :2], atol=1e-12)

        # The motion gives back what acts.
        scale = 1 + np.abs(found["bias"]).max()
        np.testing.assert_allclose(
            found["tau"], np.where(real, tau, 0), atol=1e-10 * scale
        )
        # The mass matrix is that of the kinetic energy.
        matrix, moved = found["matrix"], np.where(real, qd, 0)
        np.testing.assert_array_equal(matrix, matrix.T)
        np.testing.assert_array_equal(matrix[~real], np.eye(pairs)[~real])
        np.testing.assert_allclose(moved @ matrix @ moved / 2, kinetic, rtol=1e-12)
        # The mass centres move as stated, and the tip as its Jacobian says.
        turns = [joint == "R" for joint in topology]
        velocity, rate = found["rates"]
        np.testing.assert_allclose(velocity, found["center_rates"], atol=1e-12)
        np.testing.assert_allclose(rate, np.cumsum(turns * qd), atol=1e-12)
        jacobian = found["jacobian"]
        np.testing.assert_allclose(jacobian[:2] @ qd, found["velocity"], atol=1e-12)
        np.testing.assert_array_equal(jacobian[2], turns)


def test_what_is_given_at_fixed_pairs_does_not_matter():
    rng = np.random.default_rng(0)
    chain = chains.random_chain("RFPRF", rng)
    q, qd, tau = rng.normal(size=(3, 5))
    other = [np.where(chains.moving("RFPRF"), a, np.nan) for a in (q, qd, tau)]
    other = [np.nan_to_num(a, nan=7.0) for a in other]
    for function in (fj.forward_dynamics, fj.inverse_dynamics):
        expected = function(chain, q, qd, tau)
        np.testing.assert_array_equal(function(chain, *other), expected)
    np.testing.assert_array_equal(
        fj.tip_position(chain, other[0]), fj.tip_position(chain, q)
    )


def test_a_shorter_chain_is_a_longer_one_with_fixed_pairs():
    rng = np.random.default_rng(1)
    short = chains.random_chain("RPR", rng)
    # A massless link of no length behind the tip, and one before the first joint.
    longer = fj.Linkage(
        "FRPRF",
        length=[0, *short.length, 0],
        com=[[0, 0], *short.com, [0.3, 0.1]],
        mass=[2, *short.mass, 0],
        inertia=[1, *short.inertia, 0],
        locked=[0, *short.locked, 0.4],
        base_angle=short.base_angle,
        gravity=short.gravity,
    )
    q, qd, tau = rng.normal(size=(3, 3))
    padded = [np.pad(a, 1) for a in (q, qd, tau)]
    np.testing.assert_allclose(
        fj.forward_dynamics(longer, *padded)[1:4],
        fj.forward_dynamics(short, q, qd, tau),
        rtol=1e-13,
    )
    ratios = fj.analysis.inertia_ratios
    np.testing.assert_allclose(
        ratios(longer, padded[0])[1:4], ratios(short, q), rtol=1e-12
    )


@pytest.mark.filterwarnings("ignore::UserWarning")  # the first slide has no inertia
def test_slides_that_are_nearly_parallel_keep_their_pivot():
    # Of m - m cos^2, 4 digits would be left. Fixed pairs between and beyond the slides
    # change nothing.
    angle = 1e-6
    for topology, locked in (
        ("RPP", [0, angle, 0]),
        ("RPFPF", [0, angle, 0, 0.3, 0.1]),
    ):
        n = len(topology)
        chain = fj.Linkage(
            topology,
            length=np.zeros(n + 1),
            com=np.zeros((n, 2)),
            mass=[1, *[0] * (topology.rindex("P") - 1), 1, *[0] * (n - 1)][:n],
            inertia=np.where(chains.moving(topology), 1, 0),
            locked=locked,
            gravity=0,
        )
        tau = np.zeros(n)
        tau[1] = 1
        qdd = np.asarray(fj.forward_dynamics(chain, [0] * n, [0] * n, tau))
        # 1 N on a slide without mass that carries one of 1 kg: the pivot is sin^2 [kg].
        assert qdd[1] == pytest.approx(1 / np.sin(angle) ** 2, rel=1e-14)


def test_the_papers_equations_are_for_three_pairs():
    chain = chains.random_chain("RR", np.random.default_rng(4))
    with pytest.raises(ValueError, match="^linkage: expected three pairs"):
        fj.paper.mass_matrix(chain, np.zeros(6))


@pytest.mark.slow
def test_the_papers_equations_hold_with_fixed_pairs():
    """They give the accelerations of the reduced form, and forces that balance (15)."""
    rng = np.random.default_rng(6)
    names = ["".join(joints) for joints in itertools.product("RPF", repeat=3)]
    names = [name for name in names if "F" in name and name != "FFF"]
    arms = [chains.random_chain(name, rng) for name in names]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *arms)
    q, qd, tau = rng.normal(size=(3, len(arms), 3))

    @jax.jit
    @jax.vmap
    def both(arm, q, qd, tau):
        x, xd = fj.paper.to_chain(arm, q, qd)
        force = jnp.repeat(tau, 2)  # those of fictitious joints have no effect
        xdd = fj.paper.masked_accelerations(arm, x, xd, force)
        held = fj.paper.constraint_forces(arm, x, xd, force)
        balance = fj.paper.mass_matrix(arm, x) @ xdd - fj.paper.bias_force(arm, x, xd)
        total = (force + held).at[1:5:2].add(-(force + held)[3::2])
        reduced = fj.forward_dynamics(arm, q, qd, tau)
        return xdd, fj.paper.to_chain(arm, q, reduced)[1], balance, total

    masked, reduced, balance, total = both(batch, q, qd, tau)
    np.testing.assert_allclose(masked, reduced, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(balance, total, rtol=1e-9, atol=1e-9)


def test_shapes_are_those_of_the_chain():
    chain = chains.random_chain("RR", np.random.default_rng(5))
    with pytest.raises(ValueError, match=r"^q: expected an array of 2 .*\(3,\)"):
        fj.tip_position(chain, [0, 0, 0])
    with pytest.raises(ValueError, match="^mass: expected an array of 2 "):
        chain.replace(mass=[1, 1, 1])
    assert repr(chain).startswith("Linkage('RR'")
    assert fj.existence_factors("RRFPR").tolist() == [0, 1, 0, 1, 0, 0, 1, 0, 0, 1]
