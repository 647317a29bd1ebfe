"""Derivatives of an arm that hangs at rest."""

import diffrax
import jax
import numpy as np
import pytest
from scipy.linalg import expm

import fdof_jax as fj
from hard.scenes import arm

HANGING, END = np.array([-np.pi / 2, 0.0, 0.0]), 10.0
STILL = np.zeros(3)


def linear_theory():
    """Of q at the end in q0: the exponential of the equations linearised at rest.

    M and the Hessian of the potential by hand: uniform links of 1 m and 1 kg.
    """
    mass = np.array(
        [[7 / 3, 3 / 2, 1 / 2], [3 / 2, 4 / 3, 1 / 2], [1 / 2, 1 / 2, 1 / 3]]
    )
    absolute = np.tril(np.ones((3, 3)))  # angles from joint angles
    stiffness = absolute.T @ np.diag([2.5, 1.5, 0.5]) @ absolute * 9.81
    inertia = absolute.T @ mass @ absolute
    zero, one = np.zeros((3, 3)), np.eye(3)
    rates = np.block([[zero, one], [-np.linalg.solve(inertia, stiffness), zero]])
    return expm(rates * END)[:3, :3]


def final(q0, adjoint=diffrax.RecursiveCheckpointAdjoint()):
    state0 = fj.State(q0, STILL)
    return fj.simulate(arm(), state0, [0, END], adjoint=adjoint).q[-1]


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_the_gradient_is_that_of_linear_theory(mode):
    """Nothing moves, so that adaptive steps grow without bound, and the error of the
    tangents is not controlled."""
    if mode == "forward":
        gradient = jax.jacfwd(lambda q0: final(q0, diffrax.ForwardMode()))
    else:
        gradient = jax.jacrev(final)
    exact = linear_theory()
    error = np.abs(jax.jit(gradient)(HANGING) - exact).max()
    assert error <= 1e-6 * np.abs(exact).max()


def test_the_arm_stays():
    """Every term is 0, or what rounding of pi/2 makes of it."""
    assert np.abs(final(HANGING) - HANGING).max() < 1e-12


@pytest.mark.parametrize("solver", [diffrax.Dopri8(), diffrax.Kvaerno5()])
def test_another_solver_does_not_make_it_wrong(solver):
    """An implicit solver crosses the 10 s in a few steps: finite, and wrong."""

    def end(q0):
        adjoint = diffrax.ForwardMode()
        return fj.simulate(
            arm(), fj.State(q0, STILL), [0, END], solver=solver, adjoint=adjoint
        ).q[-1]

    exact = linear_theory()
    error = np.abs(jax.jit(jax.jacfwd(end))(HANGING) - exact).max()
    assert error <= 1e-6 * np.abs(exact).max()
