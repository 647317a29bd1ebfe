"""Scene 12: derivatives of an arm that hangs at rest."""

import diffrax
import numpy as np
from modes import jacobian

import fdof_jax as fj
from hard.scenes import linear_motion

HANGING, END = np.array([-np.pi / 2, 0.0]), 10.0
STILL = np.zeros(2)
# Two of the usual links, whose programs compile faster.
ARM = fj.Linkage(
    "RR", length=[0, 1, 1], com=[[0.5, 0]] * 2, mass=[1, 1], inertia=[1 / 12] * 2
)


def test_other_tolerances_do_not_make_it_wrong():
    """Only an explicit longest step, `dtmax`, is left unchanged."""
    controller = diffrax.PIDController(rtol=1e-8, atol=1e-8)

    def end(q0):
        return fj.simulate(
            ARM, fj.State(q0, STILL), [0, END], stepsize_controller=controller,
            adjoint=diffrax.ForwardMode(),
        ).q[-1]  # fmt: skip

    exact = linear_motion(END, links=2)
    error = np.abs(jacobian(end)(HANGING)[0] - exact).max()
    assert error <= 1e-6 * np.abs(exact).max()


def test_the_arm_stays():
    """Every term is 0, apart from the rounding of pi/2.

    The default steps, of 0.7 s, do not resolve the faster oscillation of 0.9 s. They
    amplify what they find, to less than their tolerance; shorter steps do not.
    """
    short = diffrax.PIDController(rtol=1e-11, atol=1e-11, dtmax=0.1)
    for controller, bound in ((None, 1e-11), (short, 1e-12)):
        motion = fj.simulate(
            ARM, fj.State(HANGING, STILL), np.linspace(0, END, 41),
            stepsize_controller=controller,
        )  # fmt: skip
        assert np.abs(np.asarray(motion.q) - HANGING).max() < bound


def test_an_implicit_solver_does_not_make_it_wrong():
    """It would cross the 10 s in a few steps, with a wrong gradient.

    Of one link, whose program is the smallest.
    """
    rod = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])

    def end(q0):
        adjoint = diffrax.ForwardMode()
        return fj.simulate(
            rod, fj.State(q0, STILL[:1]), [0, END],
            solver=diffrax.Kvaerno5(), adjoint=adjoint,
        ).q[-1]  # fmt: skip

    exact = np.cos(np.sqrt(9.81 * 0.5 / (1 / 3)) * END)
    error = np.abs(jacobian(end)(HANGING[:1])[0] - exact).max()
    assert error <= 1e-6
