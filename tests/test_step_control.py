"""Conditions that stop a solve, times where steps end, and norms of errors."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from elements import BAR, SLIDE
from modes import LOOPS

import fdof_jax as fj
from fdof_jax.forces import HardStops
from fdof_jax.steps.tolerances import EagerController, by_square_roots

TS = np.linspace(0, 1, 5)
SWUNG = fj.State([-0.5], [0])


def test_a_mass_matrix_that_turns_singular_is_named():
    """A link without inertia of its own is singular where the others line up."""
    arm = fj.Linkage(
        "RRR", length=[0, 1, 1, 1], com=[[0.5, 0]] * 3, mass=[1] * 3, inertia=[0.1] * 3
    )
    arm = eqx.tree_at(
        lambda a: (a.inertia, a.mass, a.com), arm,
        (jnp.array([0.1, 0, 0]), jnp.array([1.0, 0, 1]), arm.com.at[2, 0].set(1.0)),
    )  # fmt: skip
    bent, straight = jnp.array([0.0, 0.3, 0.5]), jnp.array([0.0, 0.3, 0.0])
    assert fj.analysis.inertia_ratios(arm, bent).min() > 1e-2
    assert fj.analysis.inertia_ratios(arm, straight).min() <= 1e-15
    for q, outcome in ((bent, "successful"), (straight, "ill-conditioned")):
        start = fj.State(q, jnp.zeros(3))
        assert fj.simulate(arm, start, [0, 1e-3], throw=False).outcome == outcome


@pytest.mark.slow
def test_steps_as_long_as_the_distance_of_jumps_do_not_fall_short_of_them():
    ts = np.linspace(0, 1, 101)
    forces = (fj.forces.EffortHistory(ts, np.zeros((101, 1))),)
    steps = diffrax.PIDController(rtol=1e-6, atol=1e-6, dtmax=0.01)
    motion = fj.simulate(BAR, SWUNG, TS, forces, dt0=0.01, stepsize_controller=steps)
    assert motion.stats["num_steps"] <= 102


def strict(error):
    """Returns a norm a hundred times as large as diffrax's own."""
    q, qd, *own = error
    return 100 * optimistix.rms_norm((jnp.stack(q), jnp.stack(qd), own))


@pytest.mark.slow
def test_a_norm_of_the_user_s_own_judges_errors():
    """Here it makes the tolerances a hundredth of what they are."""
    pid = fj.control.PIDController(9.0, 5.0, 1.0, 4.0, fj.references.SetPoint(0.2))
    counts = []
    for tolerance, norm in ((1e-9, {}), (1e-7, dict(norm=strict)), (1e-7, {})):
        steps = diffrax.PIDController(rtol=tolerance, atol=tolerance, **norm)
        motion = fj.simulate(BAR, SWUNG, TS, (pid,), stepsize_controller=steps)
        counts.append(int(motion.stats["num_steps"]))
    assert counts[0] == counts[1] > counts[2]


@pytest.mark.slow
def test_derivatives_through_a_bounce_under_a_norm_of_one_s_own():
    own = diffrax.PIDController(rtol=1e-8, atol=1e-8, norm=strict)
    ball = SLIDE.replace(gravity=9.81)
    floor = (HardStops(0.0, np.inf, restitution=0.5),)

    def end(height):
        scene = ball, fj.State(height[None], jnp.zeros(1)), [0, 0.6], floor
        return fj.simulate(*scene, stepsize_controller=own).q[-1, 0]

    def exactly(height):
        fall = jnp.sqrt(2 * height / 9.81)
        return 0.5 * 9.81 * fall * (0.6 - fall) - 9.81 * (0.6 - fall) ** 2 / 2

    found = jax.jit(jax.grad(end), **LOOPS)(1.0)
    np.testing.assert_allclose(found, jax.grad(exactly)(1.0), rtol=1e-8)


def test_square_roots_instead_of_powers_change_no_step():
    pid, y = EagerController(1e-9, 1e-9, dtmin=1e-13), jnp.array([0.3, 2.0])
    ends = [], []
    for error in 10.0 ** jnp.arange(-16, -2):
        at = 0.1, 0.2, y, y, None, error * jnp.array([1.0, -3.0]), 8
        for rows, controller in zip(ends, (pid, by_square_roots(pid))):
            _, state = controller.init(None, 0.1, 0.2, y, 0.1, None, None, 8)
            keep, _, end, *_ = controller.adapt_step_size(*at, state)
            rows.append([keep, end])
    np.testing.assert_allclose(*ends, rtol=1e-14)
    assert len(np.unique(ends[0], axis=0)) > 5


def test_a_kept_step_near_the_tolerance_shortens_the_next():
    y, h = jnp.array([0.3]), 0.1

    def after(kind, error):
        """Returns whether a step with this error over its tolerance is kept, and
        the length of the next one over its own."""
        pid = kind(0.0, 1e-9, safety=0.8, dtmin=0.085, force_dtmin=False)
        at = 0.0, h, y, y, None, jnp.array([error * 1e-9]), 8
        _, state = pid.init(None, 0.0, h, y, h, None, None, 8)
        keep, t0, t1, *_ = pid.adapt_step_size(*at, state)
        return float(keep), (t1 - t0) / h

    # 0.85 is the shortest step.
    for error, length in ((0.4, None), (0.6, None), (0.9, 0.85)):
        wanted = 1, length or 0.8 * error ** (-1 / 8)
        np.testing.assert_allclose(after(EagerController, error), wanted, rtol=1e-13)
    for error in (0.0, 1e-6, 0.1, 1.1, 1e3, np.nan):
        kinds = EagerController, diffrax.PIDController
        np.testing.assert_allclose(*(after(k, error) for k in kinds), rtol=1e-13)


def test_few_steps_are_rejected_at_any_tolerance():
    arm, start, forces, _ = fj.scenes.fig5()
    motion = lambda **options: fj.simulate(arm, start, [0, 2.0, 5.0], forces, **options)
    loose, tight = motion(rtol=1e-6, atol=1e-7), motion(rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(loose.q[1], tight.q[1], atol=1e-5)
    assert loose.stats["num_steps"] < tight.stats["num_steps"]
    assert 15 * tight.stats["num_rejected_steps"] < tight.stats["num_steps"]


@pytest.mark.parametrize("name", ["rtol", "atol"])
def test_derivatives_with_respect_to_a_tolerance(name):
    last = lambda x: fj.simulate(BAR, SWUNG, [0, 1.0], **{name: x}).q[-1, 0]
    with pytest.raises(RuntimeError, match=name):
        jax.eval_shape(jax.grad(last), 1e-6)
