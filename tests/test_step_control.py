"""Conditions that stop a solve, times where steps end, and norms of errors."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from modes import LOOPS, jacobian

import fdof_jax as fj
from fdof_jax.steps.looped_dopri8 import LoopedDopri8
from fdof_jax.steps.tolerances import EagerController, by_square_roots

LINKS = dict(com=[[0.5, 0]] * 3, mass=[1, 1, 1], inertia=[1 / 12] * 3)
ARM = fj.Linkage("RRR", length=[0, 1, 1, 1], **LINKS)
START = fj.State([-0.5, 0.3, 0.2], [0, 0, 0])
TS = np.linspace(0, 1, 5)
# One link, whose programs compile faster.
ROD = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[1 / 12])
SWUNG = fj.State([-0.5], [0])


class Switched(eqx.Module):
    """An effort that is on between two times."""

    jump_ts: jax.Array
    effort: jax.Array  # of one program for all, which a float would not be

    def __call__(self, t, q, qd, linkage):
        on = (t > self.jump_ts[0]) & (t < self.jump_ts[1])
        return jnp.where(on, self.effort, 0.0) * jnp.eye(q.size)[0]


def test_a_mass_matrix_that_turns_singular_is_named():
    """A link without inertia of its own is singular where the others line up."""
    arm = eqx.tree_at(lambda a: a.inertia, ARM, jnp.array([1 / 12, 0, 0]))
    arm = eqx.tree_at(lambda a: (a.mass, a.com), arm,
                      (jnp.array([1.0, 0, 1]), arm.com.at[2, 0].set(1.0)))  # fmt: skip
    bent, straight = jnp.array([0.0, 0.3, 0.5]), jnp.array([0.0, 0.3, 0.0])
    assert fj.analysis.inertia_ratios(arm, bent).min() > 1e-2
    assert fj.analysis.inertia_ratios(arm, straight).min() <= 1e-15
    for q, outcome in ((bent, "successful"), (straight, "ill-conditioned")):
        start = fj.State(q, jnp.zeros(3))
        solution = fj.simulate(arm, start, [0, 1e-3], throw=False)
        assert solution.outcome == outcome


@pytest.mark.slow
def test_steps_as_long_as_the_distance_of_jumps_do_not_fall_short_of_them():
    jumps = jnp.linspace(0, 1, 101)
    steps = diffrax.PIDController(rtol=1e-6, atol=1e-6, dtmax=0.01)
    solution = fj.simulate(
        ROD,
        SWUNG,
        TS,
        (Switched(jumps, jnp.zeros(())),),
        dt0=0.01,
        stepsize_controller=steps,
    )
    assert solution.stats["num_steps"] <= 102


@pytest.mark.slow
def test_a_sweep_lands_on_each_members_jumps():
    jumps, push = jnp.array([[0.2, 0.4], [0.6, 0.8]]), jnp.array(50.0)
    together = fj.sweep(
        ROD, SWUNG, TS, (Switched(jumps, push),), forces_axes=(Switched(0, None),),
        solver=LoopedDopri8(),
    )  # fmt: skip
    for i in range(2):
        alone = fj.simulate(ROD, SWUNG, TS, (Switched(jumps[i], push),))
        np.testing.assert_allclose(together.q[i], alone.q, atol=1e-9)


def test_jumps_need_adaptive_steps():
    with pytest.raises(ValueError, match="stepsize_controller: expected an adaptive"):
        fj.simulate(
            ARM, START, TS, (Switched(jnp.array([0.5, 0.6]), jnp.ones(())),),
            stepsize_controller=diffrax.ConstantStepSize(),
        )  # fmt: skip
    with pytest.raises(ValueError, match=r"forces\[0\]\.jump_ts: expected"):
        bad = Switched(jnp.array([[0.5, jnp.nan]]), jnp.ones(()))
        fj.simulate(ARM, START, TS, (bad,))


def strict(error):
    """Returns a norm a hundred times as large as diffrax's own."""
    q, qd, *own = error
    return 100 * optimistix.rms_norm((jnp.stack(q), jnp.stack(qd), own))


PID = fj.control.PIDController(9.0, 5.0, 1.0, 4.0, fj.references.SetPoint(0.2))
STOPS = fj.forces.HardStops(-1.7, 0.4, restitution=0.5)


SLOW = [pytest.param(forces, marks=pytest.mark.slow) for forces in ((PID,), (STOPS,))]


@pytest.mark.parametrize("forces", [(), *SLOW])
def test_a_norm_of_the_user_s_own_judges_errors(forces):
    """Here it makes the tolerances a hundredth of what they are."""
    tight = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    loose = diffrax.PIDController(rtol=1e-7, atol=1e-7)
    own = diffrax.PIDController(rtol=1e-7, atol=1e-7, norm=strict)
    counts = []
    for steps in (tight, own, loose):
        motion = fj.simulate(ROD, SWUNG, TS, forces, stepsize_controller=steps)
        counts.append(int(motion.stats["num_steps"]))
    assert counts[0] == counts[1] > counts[2]


@pytest.mark.slow
def test_derivatives_through_bounces_under_a_norm_of_one_s_own():
    def end(speed, **options):
        start = fj.State(SWUNG.q, speed)
        return fj.simulate(ROD, start, TS, (STOPS,), **options).q[-1, 0]

    own = diffrax.PIDController(rtol=1e-8, atol=1e-8, norm=strict)
    judged = dict(stepsize_controller=own), dict(rtol=1e-12, atol=1e-12)
    slopes = [jax.jit(jax.grad(partial(end, **one)), **LOOPS) for one in judged]
    reverse, right = (slope(jnp.array([1.0])) for slope in slopes)
    forward = partial(end, adjoint=diffrax.ForwardMode(), **judged[0])
    forward, _ = jacobian(forward)(jnp.array([1.0]))
    np.testing.assert_allclose(reverse, right, atol=1e-7)
    np.testing.assert_allclose(forward, right, atol=1e-7)


@pytest.mark.parametrize("kind", [diffrax.PIDController, EagerController])
def test_square_roots_instead_of_powers_change_no_step(kind):
    pid = kind(1e-9, 1e-9, dtmin=1e-13, force_dtmin=False)
    rooted, y = by_square_roots(pid), jnp.array([0.3, 2.0])
    assert rooted.icoeff == 8
    ends = {"powers": [], "roots": []}
    for error in 10.0 ** jnp.arange(-16, -2):
        at = 0.1, 0.2, y, y, None, error * jnp.array([1.0, -3.0]), 8
        for name, controller in (("powers", pid), ("roots", rooted)):
            _, state = controller.init(None, 0.1, 0.2, y, 0.1, None, None, 8)
            keep, _, end, *_ = controller.adapt_step_size(*at, state)
            ends[name].append([keep, end])
    np.testing.assert_allclose(ends["roots"], ends["powers"], rtol=1e-14)
    assert len(np.unique(ends["powers"], axis=0)) > 5


class OwnRule(diffrax.PIDController):
    """A controller whose formula only its author knows."""


@pytest.mark.parametrize(
    "controller",
    [diffrax.PIDController(1e-9, 1e-9, pcoeff=0.3, icoeff=0.4), OwnRule(1e-9, 1e-9)],
    ids=["other coefficients", "subclass"],
)
def test_other_controllers_keep_their_powers(controller):
    assert by_square_roots(controller) is controller


class NoOrder(diffrax.Tsit5):
    """A method that does not know its order."""

    def order(self, terms):
        return None


@pytest.mark.slow
def test_the_controller_may_give_the_order():
    controller = diffrax.PIDController(1e-6, 1e-6, error_order=5)
    found, expected = (
        fj.simulate(ROD, SWUNG, TS, solver=solver, stepsize_controller=controller)
        for solver in (NoOrder(), diffrax.Tsit5())
    )
    np.testing.assert_allclose(found.q, expected.q, atol=1e-12)
    with pytest.raises(ValueError, match="order of convergence"):
        fj.simulate(ROD, SWUNG, TS, solver=NoOrder(), rtol=1e-6)


def test_a_kept_step_near_the_tolerance_shortens_the_next():
    y, h = jnp.array([0.3]), 0.1

    def after(kind, error):
        """Returns whether a step with this error over its tolerance is kept, and
        the length of the next one over its own."""
        pid = kind(0.0, 1e-9, safety=0.8, dtmin=0.085, force_dtmin=False)
        at = 0.0, h, y, y, None, jnp.array([error * 1e-9]), 8
        _, state = pid.init(None, 0.0, h, y, h, None, None, 8)
        keep, t0, t1, *_ = pid.adapt_step_size(*at, state)
        return keep, (t1 - t0) / h

    for error in (0.4, 0.6):
        assert after(diffrax.PIDController, error) == (True, 1)
        keep, length = after(EagerController, error)
        assert keep
        np.testing.assert_allclose(length, 0.8 * error ** (-1 / 8), rtol=1e-13)
    assert after(EagerController, 0.9)[0]
    np.testing.assert_allclose(
        after(EagerController, 0.9)[1], 0.85
    )  # the shortest step
    for error in (0.0, 1e-6, 0.1, 1.1, 1e3, np.nan):
        for found, expected in zip(
            *(after(k, error) for k in (EagerController, diffrax.PIDController))
        ):
            np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_few_steps_are_rejected():
    arm, start, forces, _ = fj.scenes.fig5()
    ts = np.linspace(0, 5, 3)
    shortening = fj.simulate(arm, start, ts, forces, rtol=1e-9, atol=1e-9).stats
    pid = diffrax.PIDController(1e-9, 1e-9)
    own = fj.simulate(arm, start, ts, forces, stepsize_controller=pid).stats
    assert shortening["num_steps"] < own["num_steps"]
    assert 15 * shortening["num_rejected_steps"] < shortening["num_steps"]
    assert 8 * own["num_rejected_steps"] > own["num_steps"]


@pytest.mark.slow
def test_tolerances_are_as_exact_as_those_of_a_controller_of_ones_own():
    """By the programs of the test before."""
    arm, start, forces, _ = fj.scenes.fig5()
    motion = lambda **options: fj.simulate(
        arm, start, np.linspace(0, 0.5, 3), forces, **options
    )
    by_name, finer, default = motion(rtol=1e-6, atol=1e-7), motion(atol=1e-7), motion()
    controlled = motion(stepsize_controller=diffrax.PIDController(1e-6, 1e-7))
    np.testing.assert_allclose(by_name.q, controlled.q, atol=1e-6)
    steps = [int(m.stats["num_steps"]) for m in (by_name, finer, default)]
    assert steps == sorted(steps) and steps[0] < steps[-1]


@pytest.mark.parametrize("name", ["rtol", "atol"])
def test_derivatives_with_respect_to_a_tolerance(name):
    linkage, state0, *_ = fj.scenes.fig5()
    last = lambda x: fj.simulate(linkage, state0, [0, 1.0], **{name: x}).q[-1, 0]
    with pytest.raises(RuntimeError, match=name):
        jax.eval_shape(jax.grad(last), 1e-6)
