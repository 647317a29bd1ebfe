"""Messages of failed motions: what stopped them, from facts, and what helps."""

import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj

PENDULUM = fj.Linkage(
    "R",
    length=[0, 1],
    com=[[0.5, 0]],
    mass=[1],
    inertia=[1 / 12],
    base_angle=-np.pi / 2,
)
START = fj.State([1.0], [0.0])


def message(ts, forces=(), state0=START, **options):
    with pytest.raises(RuntimeError) as raised:
        fj.simulate(PENDULUM, state0, ts, forces, **options)
    return str(raised.value)


def _impossible():
    """Yields motions that cannot go on, and the beginning of what is said of each."""
    arm, start, (control,), _ = fj.scenes.fig7()
    wide = control.replace(reference=fj.CircleTask(center=[-1, 2], radius=0.75))
    yield (arm, start, (wide,)), r"forces\[0\].reference: expected a circle"
    changed = eqx.tree_at(lambda d: d.coefficient, fj.JointDamper(1.0), jnp.array(-1.0))
    yield (arm, start, (changed,)), r"forces\[0\].coefficient: expected"
    still = fj.simulation.PrescribedMotion(1, lambda t, arm: (0 * arm.mass,) * 2)
    yield (arm, start, (still,)), r"state0.q: expected"


@pytest.mark.parametrize("inputs, words", list(_impossible()))
def test_a_motion_that_cannot_go_on_is_a_result_that_names_its_cause(inputs, words):
    arm, start, forces = inputs
    motion = fj.simulate(arm, start, [0, 4.0], forces, throw=False)
    assert motion.outcome == "not finite" and np.isnan(motion.q[-1]).all()
    with pytest.raises(ValueError, match=words):
        fj.simulate(arm, start, [0, 4.0], forces)


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-11, 1e-6])
def test_an_overdamped_arm_needs_an_implicit_solver(tolerance):
    damper, few = fj.JointDamper(3e4), dict(rtol=tolerance, atol=tolerance)
    words = message([0, 5.0], (damper,), max_steps=2000, **few)
    assert "implicit solver (solver=diffrax.Kvaerno5())" in words
    assert "raise max_steps" not in words
    # The mode of the damper: 3e4 N m s over 1/3 kg m^2.
    rate = float(re.search(r"mode of (\S+)/s", words).group(1))
    assert rate == pytest.approx(9e4, rel=1e-2)
    implicit = dict(solver=diffrax.Kvaerno5(), rtol=1e-6, atol=1e-6)
    fj.simulate(PENDULUM, START, [0, 5.0], (damper,), max_steps=2000, **implicit)


def test_a_long_motion_needs_more_steps():
    words = message([0, 400.0], max_steps=500)
    assert "short" not in words and "implicit" not in words
    needed = re.search(r"some ([\d,]+) steps: raise max_steps", words).group(1)
    needed = int(needed.replace(",", ""))
    motion = fj.simulate(PENDULUM, START, [0, 400.0])
    assert needed == pytest.approx(int(motion.stats["num_steps"]), rel=0.1)


@pytest.mark.slow
def test_an_effort_that_feeds_itself_diverges():
    feeds = lambda t, q, qd, linkage: qd**3
    words = message([0, 5.0], (feeds,), fj.State([1.0], [1.0]), max_steps=150)
    assert "grows by a rate of" in words and "Kvaerno5" not in words
    # It is infinite before the end, whatever the number of steps.
    words = message([0, 50.0], (lambda t, q, qd, linkage: 5 * q**3,))
    assert "tolerance out of reach" in words and "grows by a rate of" in words


@pytest.mark.slow
def test_a_function_without_derivatives_may_run_out_of_steps():
    def called(t, q, qd, linkage):
        return jax.pure_callback(lambda q: -np.asarray(q), q, q)

    assert "raise max_steps" in message([0, 9.0], (called,), max_steps=20)


@pytest.mark.slow
def test_branches_that_push_towards_each_other():
    pushed = lambda t, q, qd, linkage: -fj.forces.switch(qd, 10.0, -10.0)
    words = message([0, 1.0], (pushed,))
    assert "too many switches" in words
    expected = r"forces\[0\] \(function\) chatters .* joint R1 push .*; JointFriction"
    assert re.search(expected, words)
    assert "ClipStepSizeController" not in words

    @jax.jit
    def traced(q):
        return fj.simulate(PENDULUM, fj.State(q, 0 * q), [0, 1.0], (pushed,)).q

    with pytest.raises(Exception, match="too many switches. Elements switch"):
        traced(jnp.ones(1)).block_until_ready()


class _Sign(fj.Element):
    """Pushes joint 2 towards its rest, or towards a line of rest, by a sign."""

    slope: fj.Values = fj.field((), unit="1/s")

    def __call__(self, t, q, qd, linkage):
        side = fj.forces.switch(qd[1] + self.slope * q[1], 20.0, -20.0)
        return -jnp.array([0, 1]) * side


@pytest.mark.slow
@pytest.mark.parametrize(
    "forces, words",
    [
        ((fj.JointDamper(0.1), _Sign(0.0)), "JointFriction lets it stick"),
        # What it chatters about is no friction, or it would stick by what is there.
        ((fj.JointDamper(0.1), _Sign(1.0)), "let the effort change continuously"),
        (
            (fj.forces.JointFriction([9.0, 0.0]), _Sign(0.0)),
            "let the effort change continuously",
        ),
    ],
)
def test_what_chatters_is_named_with_its_joint(forces, words):
    arm, start = fj.scenes.double_pendulum().linkage, fj.State([0.3, 0.1], [0.0, -0.3])
    with pytest.raises(RuntimeError, match="too many switches") as raised:
        fj.simulate(arm, start, [0, 2.0], forces)
    found = str(raised.value)
    assert "forces[1] (_Sign) chatters" in found and "at joint R2" in found
    assert words in found


@pytest.mark.slow
def test_an_arm_that_is_singular_under_task_space_control_is_named():
    arm, target = fj.scenes.double_pendulum().linkage, np.array([1.2, 0.5])

    def pulled(t, q, qd, linkage, inverse):
        J = fj.tip_jacobian(linkage, q)[:2]
        away = target - fj.tip_position(linkage, q)
        return inverse(J) @ (100 * away - 20 * J @ qd)

    def inverting(t, q, qd, linkage):
        return pulled(t, q, qd, linkage, jnp.linalg.inv)

    def damped(t, q, qd, linkage):
        near = lambda J: J.T @ jnp.linalg.inv(J @ J.T + 1e-2 * jnp.eye(2))
        return pulled(t, q, qd, linkage, near)

    start = fj.State([0.3, 1e-9], [0, 0])
    with pytest.raises(RuntimeError) as raised:
        fj.simulate(arm, start, [0, 0.1], (fj.JointDamper(0.1), inverting))
    J = np.asarray(fj.tip_jacobian(arm, start.q))[:2]
    words = rf"forces\[1\] .* J is singular .*number {np.linalg.cond(J):.2g}\b.* damped"
    assert re.search(words.replace("+", r"\+"), str(raised.value))
    # As it says, a damped inverse helps; what is straight for no reason is not named.
    assert fj.simulate(arm, start, [0, 0.1], (damped,)).outcome == "successful"
    with pytest.raises(RuntimeError) as raised:
        fj.simulate(arm, start, [0, 20.0], (damped,), dt0=10.0, max_steps=1)
    assert str(raised.value).endswith("No step met the tolerance.")


class Careless(diffrax.AbstractAdaptiveStepSizeController):
    """Keeps all steps, whatever their errors."""

    rtol: float = 1e-6
    atol: float = 1e-6
    norm: object = None

    def wrap(self, direction):
        return self

    def init(self, terms, t0, *arguments):
        return t0 + 0.125, ()

    def adapt_step_size(self, t0, t1, *arguments):
        going_on = False, (), diffrax.RESULTS.successful
        return jnp.array(True), t1, t1 + 0.125, *going_on


def test_a_motion_that_is_lost_is_no_success():
    """Heun's method is unstable here; nobody notices but `simulate`."""
    damper, times = (fj.JointDamper(200.0),), np.linspace(0, 128, 7)
    steps = dict(solver=diffrax.Heun(), stepsize_controller=Careless())
    motion = fj.simulate(PENDULUM, START, times, damper, throw=False, **steps)
    assert motion.outcome == "not finite" and motion.stats["time_reached"] < 128
