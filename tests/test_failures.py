"""Messages of failed motions: what stopped them, from facts, and what helps."""

import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import BAR

import fdof_jax as fj

PENDULUM = BAR.replace(base_angle=-np.pi / 2)
START = fj.State([1.0], [0.0])
DOUBLE = fj.scenes.double_pendulum().linkage


def message(ts, forces=(), state0=START, arm=PENDULUM, **options):
    with pytest.raises(RuntimeError) as raised:
        fj.simulate(arm, state0, ts, forces, **options)
    return str(raised.value)


def _impossible():
    """Yields motions that cannot go on, and the beginning of what is said of each."""
    arm, start, (control,), _ = fj.scenes.fig7()
    wide = control.replace(reference=fj.CircleTask(center=[-1, 2], radius=0.75))
    yield (arm, start, (wide,)), r"forces\[0\].reference: expected a circle"
    changed = eqx.tree_at(lambda d: d.coefficient, fj.JointDamper(1.0), jnp.array(-1.0))
    yield (PENDULUM, START, (changed,)), r"forces\[0\].coefficient: expected"
    still = fj.simulation.PrescribedMotion(1, lambda t, arm: (0 * arm.mass,) * 2)
    yield (PENDULUM, START, (still,)), r"state0.q: expected"


@pytest.mark.parametrize("inputs, words", list(_impossible()))
def test_a_motion_that_cannot_go_on_is_a_result_that_names_its_cause(inputs, words):
    arm, start, forces = inputs
    motion = fj.simulate(arm, start, [0, 4.0], forces, throw=False)
    assert motion.outcome == "not finite" and np.isnan(motion.q[-1]).all()
    with pytest.raises(ValueError, match=words):
        fj.simulate(arm, start, [0, 4.0], forces)


@pytest.mark.slow
def test_an_overdamped_arm_needs_an_implicit_solver():
    damper = (fj.JointDamper(3e4),)
    words = message([0, 5.0], damper, max_steps=2000)
    assert "implicit solver (solver=diffrax.Kvaerno5())" in words
    assert "raise max_steps" not in words
    # The mode of the damper: 3e4 N m s over 1/3 kg m^2.
    rate = float(re.search(r"mode of (\S+)/s", words).group(1))
    assert rate == pytest.approx(9e4, rel=1e-2)


def test_a_long_motion_needs_more_steps():
    words = message([0, 400.0], max_steps=500)
    assert "short" not in words and "implicit" not in words
    needed = re.search(r"some ([\d,]+) steps: raise max_steps", words).group(1)
    needed = int(needed.replace(",", ""))
    motion = fj.simulate(PENDULUM, START, [0, 400.0])
    assert needed == pytest.approx(int(motion.stats["num_steps"]), rel=0.1)


class _Fed(eqx.Module):
    """An effort that grows with the cubes of rate and position."""

    by_rate: jax.Array
    by_place: jax.Array

    def __call__(self, t, q, qd, linkage):
        return self.by_rate * qd**3 + self.by_place * q**3


@pytest.mark.slow
def test_efforts_that_feed_themselves_diverge():
    by_rate, by_place = (_Fed(*jnp.array(both)) for both in ([1.0, 0], [0, 5.0]))
    words = message([0, 5.0], (by_rate,), fj.State([1.0], [1.0]), max_steps=150)
    assert "grows by a rate of" in words and "Kvaerno5" not in words
    # It is infinite before the end, whatever the number of steps.
    words = message([0, 50.0], (by_place,))
    assert "tolerance out of reach" in words and "grows by a rate of" in words


@pytest.mark.slow
def test_a_function_without_derivatives_may_run_out_of_steps():
    called = lambda t, q, qd, linkage: jax.pure_callback(lambda q: -np.array(q), q, q)
    assert "raise max_steps" in message([0, 9.0], (called,), max_steps=20)


@pytest.mark.slow
def test_a_force_that_fails_at_the_start_is_named():
    few, none = lambda t, q, qd: q, lambda t, q, qd, linkage: q * np.nan
    damper = fj.JointDamper(1.0)
    with pytest.raises(TypeError, match=r"forces\[1\]: .* \(t, q, qd, linkage\)"):
        fj.simulate(PENDULUM, START, [0, 1], (damper, few))
    words = message([0, 1], (damper, none))
    assert "forces[1] is not finite at the start" in words


class _Sign(fj.Element):
    """Pushes the last joint towards its rest, or towards a line of rest, by a sign."""

    slope: fj.Values = fj.field((), unit="1/s")

    def __call__(self, t, q, qd, linkage):
        side = fj.forces.switch(qd[-1] + self.slope * q[-1], 20.0, -20.0)
        return -side * jnp.eye(q.size)[-1]


@pytest.mark.slow
@pytest.mark.parametrize("slope, words", [
    (0.0, "JointFriction lets it stick"),
    (1.0, "let the effort change continuously"),  # it chatters about no friction
])  # fmt: skip
def test_what_chatters_is_named_with_its_joint(slope, words):
    forces = fj.JointDamper(0.1), _Sign(slope)
    found = message([0, 2.0], forces, fj.State([0.3, 0.1], [0.0, -0.3]), DOUBLE)
    assert "too many switches" in found and "ClipStepSizeController" not in found
    assert "forces[1] (_Sign) chatters" in found and "at joint R2" in found
    assert words in found


@pytest.mark.slow
def test_an_arm_that_is_singular_under_task_space_control_is_named():
    def pulled(t, q, qd, linkage, inverse):
        J = fj.tip_jacobian(linkage, q)[:2]
        away = jnp.array([1.2, 0.5]) - fj.tip_position(linkage, q)
        return inverse(J) @ (100 * away - 20 * J @ qd)

    def inverting(t, q, qd, linkage):
        return pulled(t, q, qd, linkage, jnp.linalg.inv)

    def damped(t, q, qd, linkage):
        near = lambda J: J.T @ jnp.linalg.inv(J @ J.T + 1e-2 * jnp.eye(2))
        return pulled(t, q, qd, linkage, near)

    start = fj.State([0.3, 1e-9], [0, 0])
    found = message([0, 0.1], (fj.JointDamper(0.1), inverting), start, DOUBLE)
    J = np.asarray(fj.tip_jacobian(DOUBLE, start.q))[:2]
    words = rf"forces\[1\] .* J is singular .*number {np.linalg.cond(J):.2g}\b.* damped"
    assert re.search(words.replace("+", r"\+"), found)
    # As it says, a damped inverse helps; what is straight for no reason is not named.
    assert fj.simulate(DOUBLE, start, [0, 0.1], (damped,)).outcome == "successful"
    words = message([0, 20.0], (damped,), start, DOUBLE, dt0=10.0, max_steps=1)
    assert words.endswith("No step met the tolerance.")


def test_a_motion_that_is_lost_is_no_success():
    """Heun's method is unstable here; nobody notices but `simulate`."""
    scene = PENDULUM, START, np.linspace(0, 128, 7), (fj.JointDamper(200.0),)
    steps = dict(stepsize_controller=diffrax.ConstantStepSize(), dt0=0.125)
    with pytest.raises(RuntimeError, match="not finite"):
        fj.simulate(*scene, solver=diffrax.Heun(), **steps)
    motion = fj.simulate(*scene, throw=False, solver=diffrax.Heun(), **steps)
    assert motion.outcome == "not finite"
    finite = np.isfinite(motion.q).all(axis=1)
    assert not finite[-1] and motion.stats["time_reached"] == motion.ts[finite][-1]
