"""Identities that hold for every linkage, state and effort, and MuJoCo's answers."""

import functools
import itertools

import chains
import jax
import jax.numpy as jnp
import jax.test_util
import mujoco
import numpy as np
import pytest
from helpers import random_linkage
from hypothesis import given, settings, strategies as st

import fdof_jax as fj
from fdof_jax.mechanics.kinematics import mass_center_velocities


@jax.jit
def everything(linkage, q, qd, tau, force):
    """Returns what the identities compare, in joint and in the paper's coordinates."""
    x, xd = fj.paper.to_chain(linkage, q, qd)
    qdd = fj.forward_dynamics(linkage, q, qd, tau)
    energies = lambda q, qd: fj.energy(linkage, q, qd)
    energy, rate = jax.jvp(energies, (q, qd), (qd, qdd))
    at_rest = lambda qdd: fj.inverse_dynamics(linkage, q, 0 * q, qdd)
    chain = lambda q: fj.paper.to_chain(linkage, q, qd)[0]
    # Efforts of joints are those of the chain's real joints, and 0 at fictitious ones.
    scattered = linkage.ef * jnp.repeat(tau, 2)
    return dict(
        xd=xd,
        kinetic=energy[0],
        power=sum(rate),
        inverse=fj.inverse_dynamics(linkage, q, qd, qdd),
        matrix=fj.mass_matrix(linkage, q),
        inverse_matrix=jax.jacfwd(at_rest)(0 * q),
        full=fj.paper.mass_matrix(linkage, x),
        slopes=jax.jacfwd(chain)(q),
        masked=fj.paper.masked_accelerations(linkage, x, xd, scattered),
        # Accelerations are mapped as rates are.
        reduced=fj.paper.to_chain(linkage, q, qdd)[1],
        xdd=fj.paper.masked_accelerations(linkage, x, xd, force),
        constraint=fj.paper.constraint_forces(linkage, x, xd, force),
        bias=fj.paper.bias_force(linkage, x, xd),
    )


# Slides alone in a plane are two at most.
NAMES = ["".join(joints) for joints in itertools.product("RPF", repeat=3)]
NAMES = [name for name in NAMES if name not in ("FFF", "PPP")]


@given(st.sampled_from(NAMES), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_identities(topology, seed):
    rng, real = np.random.default_rng(seed), chains.moving(topology)
    linkage = random_linkage(topology, rng)
    (q, qd, tau), force = rng.normal(size=(3, 3)), rng.normal(size=6)
    found = everything(linkage, q, qd, tau, force)
    v = {name: np.asarray(value) for name, value in found.items()}
    close = functools.partial(np.testing.assert_allclose, rtol=1e-9)

    # The mass matrix: symmetric, positive, that of the chain and of the energy.
    for matrix in (v["full"], v["matrix"]):
        np.testing.assert_array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(v["matrix"]).min() > 0
    among = np.ix_(real, real)
    projected = (v["slopes"].T @ v["full"] @ v["slopes"])[among]
    for matrix in (v["matrix"], v["inverse_matrix"]):
        close(matrix[among], projected, atol=1e-12)
    close(v["xd"] @ v["full"] @ v["xd"] / 2, v["kinetic"], rtol=1e-12, atol=1e-13)

    # Motion: masked as in the paper, its inverse, and its power.
    scale = 1 + np.abs(v["reduced"]).max()
    close(v["masked"], v["reduced"], rtol=0, atol=1e-11 * scale)
    close(v["inverse"], np.where(real, tau, 0), atol=1e-10)
    close(v["power"], (tau * real) @ qd, atol=1e-9)

    # With constraint forces, (15) gives the same accelerations without masks.
    balance = force + v["constraint"]
    balance[1:5:2] -= (force + v["constraint"])[3::2]
    close(v["full"] @ v["xdd"] - v["bias"], balance, atol=1e-9)


@jax.jit  # one program for all chains of a length
def as_mujoco(chain, q, qd, tau):
    qdd = fj.forward_dynamics(chain, q, qd, tau)
    return dict(
        qdd=qdd,
        tau=fj.inverse_dynamics(chain, q, qd, qdd),
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
@pytest.mark.parametrize("pairs", [2, 8])
def test_motion_energy_and_kinematics_equal_mujoco(pairs):
    rng = np.random.default_rng(pairs)
    drawn = rng.choice(list("RPF"), (99, pairs), p=[0.5, 0.3, 0.2])
    names = [n for n in map("".join, drawn) if "R" in n or 0 < n.count("P") < 3][:12]
    for topology in names:
        chain, real = chains.random_chain(topology, rng), chains.moving(topology)
        q, qd, tau = rng.normal(size=(3, pairs)) * [[1], [2], [5]]
        found = jax.tree.map(np.asarray, as_mujoco(chain, q, qd, tau))
        model = mujoco.MjModel.from_xml_string(fj.to_mjcf(chain))
        model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.qfrc_applied = q[real], qd[real], tau[real]
        mujoco.mj_forward(model, data)
        error = np.abs(found["qdd"][real] - data.qacc).max()
        assert error <= 1e-10 * (1 + np.abs(data.qacc).max()), topology
        assert (found["qdd"][~real] == 0).all()
        (kinetic, _), close = found["energy"], np.testing.assert_allclose
        close(found["tip"], data.site("tip").xpos[:2], atol=1e-12)
        close(found["energy"][::-1], data.energy, rtol=1e-11, atol=1e-11)
        close(found["centers"], data.xipos[2:, :2], atol=1e-12)
        close(found["joints"], data.xpos[2:, :2], atol=1e-12)

        # The motion gives back what acts.
        scale = 1 + np.abs(found["qdd"]).max()
        close(found["tau"], np.where(real, tau, 0), atol=1e-10 * scale)
        # The mass matrix is that of the kinetic energy.
        matrix, moved = found["matrix"], np.where(real, qd, 0)
        np.testing.assert_array_equal(matrix, matrix.T)
        np.testing.assert_array_equal(matrix[~real], np.eye(pairs)[~real])
        close(moved @ matrix @ moved / 2, kinetic, rtol=1e-12)
        # The mass centres move as stated, and the tip as its Jacobian says.
        turns = [joint == "R" for joint in topology]
        velocity, rate = found["rates"]
        close(velocity, found["center_rates"], atol=1e-12)
        close(rate, np.cumsum(turns * qd), atol=1e-12)
        close(found["jacobian"][:2] @ qd, found["velocity"], atol=1e-12)
        np.testing.assert_array_equal(found["jacobian"][2], turns)


@pytest.mark.filterwarnings("ignore::UserWarning")  # the first slide has no inertia
@pytest.mark.parametrize(
    "topology, locked", [("RPP", [0, 1e-6, 0]), ("RPFPF", [0, 1e-6, 0, 0.3, 0.1])]
)
def test_slides_that_are_nearly_parallel_keep_their_pivot(topology, locked):
    """1 N on a slide without mass that carries one of 1 kg: the pivot is sin^2 [kg].

    Of m - m cos^2, 4 digits would be left. Fixed pairs between and beyond the slides
    change nothing.
    """
    n, last = len(topology), topology.rindex("P")
    chain = fj.Linkage(
        topology, length=np.zeros(n + 1), com=np.zeros((n, 2)), locked=locked,
        mass=np.eye(n)[0] + np.eye(n)[last], gravity=0,
        inertia=np.where(chains.moving(topology), 1, 0),
    )  # fmt: skip
    qdd = np.asarray(fj.forward_dynamics(chain, [0] * n, [0] * n, np.eye(n)[1]))
    assert qdd[1] == pytest.approx(1 / np.sin(1e-6) ** 2, rel=1e-14)


def test_the_papers_equations_are_for_three_pairs():
    chain = chains.random_chain("RR", np.random.default_rng(4))
    with pytest.raises(ValueError, match="^linkage: expected three pairs"):
        fj.paper.mass_matrix(chain, np.zeros(6))
