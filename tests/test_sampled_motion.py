"""A motion under sampled control in pictures, tables and a line of text."""

from functools import partial

import diffrax
import numpy as np
import pytest
from figures import lines, tidy as tidy, tops, values
from test_sampled_control import DISC

import fdof_jax as fj
from fdof_jax import drawing, plotting

TAU = np.array([[4.0], [-8.0], [2.0], [6.0]])  # of an inertia of 2 kg m^2


def disc_motion() -> fj.Solution:
    """Returns the exact motion of a disc from rest under the held efforts."""
    ts, qdd = np.linspace(0, 2, 5), TAU / 2
    qd = np.append([[0.0]], np.cumsum(qdd / 2, axis=0), axis=0)
    q = np.append([[0.0]], np.cumsum((qd[1:] + qd[:-1]) / 4, axis=0), axis=0)
    acting = np.append(TAU, TAU[-1:], axis=0)
    result = diffrax.RESULTS.successful
    return fj.Solution(ts, q, qd, {}, result, tau=TAU, acting=acting)


CONTROL = fj.PDController(0.0, 0.0, 8.0, lambda t, linkage: (t[None], t[None]))


def test_efforts_are_those_held():
    motion, damper = disc_motion(), fj.JointDamper(0.5)
    total, (held, damped) = fj.joint_efforts(DISC, (CONTROL, damper), motion)
    np.testing.assert_array_equal(held, np.append(TAU, TAU[-1:], axis=0))
    np.testing.assert_array_equal(total, held + damped)
    with pytest.raises(ValueError, match=r"forces: expected \(control, \*forces\)"):
        fj.joint_efforts(DISC, (), motion)


def test_pictures_take_it():
    motion, forces = disc_motion(), (CONTROL,)
    assert lines(drawing.chrono_cyclograph(DISC, motion, every=1.0))["tip path"]
    (ax,) = plotting.effort_profile(DISC, forces, motion).axes
    (saturated,) = [line for line in ax.lines if line.get_gid() == "saturated 1"]
    assert saturated.get_xdata() == 0.5
    (ax,) = plotting.motion_profile(DISC, motion).axes
    np.testing.assert_allclose(values(ax)[0], np.rad2deg(motion.q[:, 0]))


def test_the_work_of_held_efforts_is_exact():
    motion = disc_motion()
    ax = plotting.energy_stack(DISC, (CONTROL,), motion)
    top, (line,) = tops(ax, motion.ts)["taken out"], values(ax)
    np.testing.assert_allclose(top, line, rtol=1e-12)
    assert line[-1] == 1.75  # [J] put in
    # The spring pulls as it did at a sample, and stores nothing.
    spring = fj.SpringDamper(fj.Point(0, 1), fj.Point(1, 0, 1), stiffness=9.0)
    ax = plotting.energy_stack(DISC, (spring,), disc_motion())
    np.testing.assert_allclose(values(ax)[0][-1], 1.75)  # as above


def test_tables_take_it():
    motion = disc_motion()
    found = fj.to_pandas(DISC, motion)
    assert list(found) == ["R1 [rad]", "R1 [rad/s]", "outcome"]
    assert fj.to_xarray(DISC, motion).outcome == "successful" == motion.outcome


def test_it_is_told_in_a_line():
    expected = "Solution(motions: 1; times: 5, 0 to 2 s; outcome: successful)"
    assert repr(disc_motion()) == expected


def test_a_solve_that_fails_raises_an_error_unless_told_otherwise():
    start, sample = fj.State([0.0], [0.0]), partial(fj.simulate_sampled, DISC)
    with pytest.raises(RuntimeError, match="out of steps"):
        sample(start, fj.JointEffort([1.0]), 0.5, 4, max_steps=3)
    motion = sample(start, fj.JointEffort([1.0]), 0.5, 4, max_steps=3, throw=False)
    assert motion.outcome == "out of steps"
