"""Modes along a motion: known frequencies, saturation, stable steps."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chains import Hold
from test_linearization import ROD, STILL, held, modes_at, slopes

import fdof_jax as fj
from fdof_jax import scenes


def test_a_hanging_chain_of_point_masses_swings_as_is_known():
    """Squared frequencies in g/l are the zeros of Laguerre's L3."""
    linkage = scenes.fig5().linkage
    hanging, failed = ([-np.pi / 2, 0.0, 0.0], STILL), ([0.3, np.nan, 0.0], STILL)
    free = (fj.JointDamper(0.0),)  # shares the program of Fig 3
    modes = modes_at(linkage, free, hanging, failed)
    zeros = np.polynomial.laguerre.lagroots([0, 0, 0, 1])
    expected = np.repeat(np.sqrt(9.81 * zeros), 2)
    np.testing.assert_allclose(modes.frequency[0], expected, rtol=1e-9)
    np.testing.assert_allclose(modes.damping[0], 0, atol=1e-9)
    assert np.isnan(modes.eigenvalues[1]).all() and np.isnan(modes.longest_step[1])
    weightless = eqx.tree_at(lambda k: k.gravity, linkage, jnp.array(0.0))
    drifting = modes_at(weightless, free, (STILL + 0.3, STILL), (STILL, STILL))
    assert (drifting.longest_step > 10).all()  # nothing to be stable against


def test_the_modes_of_fig_3_at_rest():
    scene = scenes.fig3()
    absolute = np.array([-47.72631099390626, -135, -45]) * np.pi / 180
    q = np.diff(absolute, prepend=0)
    modes = modes_at(scene.linkage, scene.forces, (q, STILL), (q, STILL))
    # From an independent computation, to four digits.
    known = [-0.4033, -1.645, -0.3471 - 2.1239j, -0.3471 + 2.1239j, -6.161, -31.36]
    found = modes.eigenvalues[0]
    found[2:4] = found[2:4][np.argsort(found[2:4].imag)]
    np.testing.assert_allclose(found, known, rtol=2e-4)
    np.testing.assert_allclose(modes.damping[0, [0, 5]], 1)
    np.testing.assert_allclose(modes.damping[0, 2], 0.3471 / abs(known[2]), rtol=2e-4)


@pytest.mark.parametrize("kd", [0.5, 10.0, 40.0])
def test_longer_steps_than_the_longest_are_unstable(kd):
    forces = (held(ROD, STILL, [400.0, 300.0, 200.0], [kd] * 3),)
    modes = modes_at(ROD, forces, (STILL, STILL), (STILL, STILL))
    z = modes.longest_step[0] * modes.eigenvalues[0]
    growth = lambda z: np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24).max()
    assert (modes.damping > 0).all()
    assert growth(z) < 1 < growth(1.15 * z)


def test_a_saturated_joint_has_no_gains():
    kp, kd = np.array([400.0, 300.0, 200.0]), np.array([10.0, 8.0, 6.0])
    target = jnp.array([0.3, -0.2, 0.1])
    controller = fj.PDController(kp, kd, [1e3, 30.0, 1e3], Hold(target))
    q = np.array([0.2, 0.4, 0.3])  # the second joint is off by 180 N m
    modes = modes_at(ROD, (controller,), (q, STILL), (np.array(target), STILL))

    def rates(y):
        efforts = kp * (target - y[:3]) - kd * y[3:]
        efforts = efforts.at[1].set(-30.0)
        return np.concatenate([y[3:], fj.forward_dynamics(ROD, y[:3], y[3:], efforts)])

    A = slopes(rates, np.concatenate([q, STILL]))
    expected = np.sort(np.abs(np.linalg.eigvals(A)))
    np.testing.assert_allclose(modes.frequency[0], expected, rtol=1e-6)
    assert modes.frequency[1, 0] > 1.3 * modes.frequency[0, 0]
    np.testing.assert_allclose(modes.longest_step, 2.6 / modes.frequency[:, -1])


def test_modes_are_refused_of_what_is_traced_or_stacked():
    def of(q):
        rows = fj.Solution(jnp.zeros(1), q, q, {}, diffrax.RESULTS.successful)
        return fj.analysis.closed_loop_modes(ROD, (), rows).frequency

    for call in jax.jit(of), lambda q: of(q[None]):
        with pytest.raises(ValueError, match="solution: expected one motion"):
            call(jnp.zeros((1, 3)))


def test_fixed_pairs_have_no_modes():
    linkage = ROD.replace(topology="RFR")
    forces = (held(linkage, STILL, [400.0, 0.0, 200.0], [10.0, 0.0, 6.0]),)
    modes = modes_at(linkage, forces, (STILL, STILL), (STILL, STILL))
    assert modes.eigenvalues.shape == (2, 4)
    full = np.asarray(fj.linearize(linkage, fj.State(STILL, STILL), forces).A)
    moving = np.array([0, 2, 3, 5])
    expected = np.abs(np.linalg.eigvals(full[np.ix_(moving, moving)]))
    np.testing.assert_allclose(modes.frequency[0], np.sort(expected), rtol=1e-9)
    assert modes.frequency.min() > 1 and (modes.damping > 0).all()
