"""Motions whose elements switch: where steps end, and derivatives through switches."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from modes import ADJOINT, LOOPS, jacobian
from switching_scenes import BUMPER, CABLE, LIMITED, RODS as ARM, scene

import fdof_jax as fj
from fdof_jax.forces.switches import Switches
from fdof_jax.steps.looped_dopri8 import LoopedDopri8

FORWARD, TANGENTS = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
# One link, whose programs compile faster.
ROD = fj.Linkage("R", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1])
CASES = jax.tree.map(lambda *a: np.array(a), LIMITED, CABLE, BUMPER)
# Of the last positions: Richardson differences of tight solves. What varies is the time
# at which the limited move begins, or the first angle of a fall to the cable.
PUBLISHED = [[-0.459781, 0.642768, 0.038107], [0.587835, 0.200989, 0.206584]]


def motion(x, case, **options):
    arm, start, forces, end = scene(x, case)
    ts = jnp.stack([jnp.zeros_like(end), jnp.asarray(end)])
    return fj.simulate(arm, start, ts, forces, **options)


@partial(jax.jit, **LOOPS)
def slopes(x, tolerance):
    """Derivatives of the last positions (case, joint), and the motions."""

    def end(x, case):
        found = motion(x, case, adjoint=FORWARD, rtol=tolerance, atol=tolerance)
        return found.q[-1], found

    def slope(case):
        return jax.jvp(partial(end, case=case), (x,), (1.0,), has_aux=True)[1:]

    # One at a time: a batch takes longer to compile.
    return jax.lax.map(slope, CASES)


def differences(function, x, h):
    """Returns a derivative by differences, extrapolated from two lengths of step."""
    slope = lambda h: (function(x + h) - function(x - h)) / (2 * h)
    return (4 * slope(h / 2) - slope(h)) / 3


@pytest.mark.slow
def test_derivatives_are_those_of_tight_differences():
    found, motions = slopes(0.1, 1e-11)
    np.testing.assert_allclose(found[:2], PUBLISHED, atol=1e-6)
    assert (motions.stats["num_switches"] >= 1).all()
    tight = lambda x: slopes(x, 1e-13)[1].q[:, -1]
    exact = differences(tight, 0.1, 1e-4)[1:]  # a move's start is a kink of its own
    np.testing.assert_allclose(found[1:], exact, atol=1e-8)


@pytest.mark.slow
def test_a_motion_tells_of_its_switches():
    arm, start, (_, spring, _), end = scene(0.1, CABLE)
    fall = fj.simulate(arm, start, jnp.array([0.0, 1.0]) * end, (spring,))
    assert fall.stats["num_switches"] == 2
    assert 0.1 < fall.stats["slowest_crossing"] < 10
    free = fj.simulate(ARM, fj.State(jnp.zeros(3), jnp.zeros(3)), [0, 0.1])
    assert "num_switches" not in free.stats


class Turning(fj.Element):
    """A slide that is pulled back, with marks on its way and on its velocity.

    From 3 m/s on, it turns back at 0.45 m.
    """

    depth: fj.Values = fj.field((), unit="m")

    def __call__(self, t, q, qd, linkage):
        pace = jnp.sqrt(20 * self.depth)
        slower = fj.forces.switch(qd - 1.05 * pace, 0.0, 1e-9)
        return -10 + slower + fj.forces.switch(q - 0.45 + self.depth, 1e-9, 0.0)


@pytest.mark.slow
def test_what_nearly_grazes_is_seen_beside_another_switch():
    """The velocity passes its mark just before, so that the step is short."""
    slide = fj.Linkage(
        "P", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1], gravity=0
    )
    for depth in (0.1, 1e-2, 3e-4):
        found = fj.simulate(slide, fj.State([0], [3]), [0, 0.5], (Turning(depth),))
        assert found.stats["num_switches"] == 3
        share = np.sqrt(depth / 0.45)
        assert found.stats["slowest_crossing"] == pytest.approx(share, rel=0.2)


class Rough(fj.Element):
    """Friction that is greater in one half of the range, by a jump."""

    level: fj.Values = fj.field((), unit="N m s/rad")

    def __call__(self, t, q, qd, linkage):
        return -self.level * fj.forces.switch(q - 0.1, 4.0, 0.5) * qd


@pytest.mark.slow
def test_both_modes_hessians_of_a_batch_and_other_solvers():
    """Derivatives in a shift of the start and in the friction."""
    speeds = jnp.array([[2.5], [6.0], [-3.0]])  # there and back, there, not there

    def end(z, speed, tolerance=1e-12, **options):
        start, friction = fj.State(z[:1], speed), Rough(jnp.exp(z[1]))
        motion = fj.simulate(
            ROD, start, [0, 0.5], (friction,), rtol=tolerance, atol=tolerance, **options
        )
        return motion.q[-1], motion.stats["num_switches"]

    def slope_twice(z, speed):
        at = lambda z: end(z, speed, adjoint=FORWARD)
        slope, switches = jax.jacfwd(at, has_aux=True)(z)
        return slope, (slope, switches)

    hessian = jax.vmap(jax.jacfwd(slope_twice, has_aux=True), (None, 0))
    both, zero = jax.jit(hessian, **LOOPS), jnp.zeros(2)
    twice, (slope, switches) = both(zero, speeds)
    assert switches.tolist() == [2, 1, 0]
    slopes = lambda z: both(z, speeds)[1][0]
    exact = [differences(lambda h, e=e: slopes(h * e), 0, 1e-4) for e in np.eye(2)]
    exact = np.stack(exact, axis=-1)
    size = np.abs(exact).max(axis=(1, 2, 3), keepdims=True)
    assert (np.abs(twice - exact) < 1e-5 * size).all()
    assert (np.abs(twice - twice.swapaxes(2, 3)) < 1e-8 * size).all()
    # Alone among members like itself, by the same program.
    alone = [both(zero, jnp.tile(speed, (3, 1)))[0][0] for speed in speeds]
    assert (np.abs(twice - np.stack(alone)) < 1e-8 * size).all()

    last = lambda z: end(z, speeds[0], adjoint=ADJOINT)[0][0]
    backward = jax.jit(jax.grad(last), **LOOPS)(zero)
    np.testing.assert_allclose(backward, slope[0, 0], rtol=1e-10)
    other = lambda z: end(z, speeds[0], 1e-9, adjoint=FORWARD, solver=diffrax.Tsit5())
    found, _ = jacobian(lambda z: other(z)[0])(zero)
    np.testing.assert_allclose(found, slope[0], atol=1e-6)


class BangBang(fj.Element):
    """Efforts that push every joint towards rest, from both sides alike."""

    level: fj.Values = fj.field((), unit="N m", minimum=0)

    def __call__(self, t, q, qd, linkage):
        return -fj.forces.switch(qd, self.level, -self.level)


@pytest.mark.slow
def test_chatter_is_named_and_spoils_no_other_member():
    start = fj.State(jnp.array([-1.5]), jnp.array([0.5]))
    motion = lambda level: fj.simulate(
        ROD, start, [0, 0.1], (BangBang(level),), throw=False, solver=LoopedDopri8()
    )
    found = jax.jit(jax.vmap(motion))(jnp.array([0.0, 100.0]))
    assert found.outcome.tolist() == ["successful", "too many switches"]
    assert jnp.isfinite(found.q[0]).all()


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [FORWARD, TANGENTS, ADJOINT])
def test_switches_of_a_plain_function_are_located(adjoint):
    """A slide at 1 m/s is braked beyond a level: both are in the function's closure."""
    slide = fj.Linkage("P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1])
    slide, start = slide.replace(gravity=0.0), fj.State([0.0], [1.0])

    def place(numbers):
        level, brake = numbers
        force = lambda t, q, qd, linkage: fj.forces.switch(q - level, -brake, 0.0)
        motion = fj.simulate(slide, start, [0, 1.0], (force,), adjoint=adjoint)
        return motion.q[-1, 0], motion.stats["num_switches"]

    derivative = jax.jacfwd if adjoint is FORWARD else jax.grad
    slopes = jax.jit(derivative(place, has_aux=True), **LOOPS)
    found, switches = slopes(jnp.array([0.4, 0.5]))
    assert switches == 1
    np.testing.assert_allclose(found, [0.5 * 0.6, -(0.6**2) / 2], rtol=1e-10)


def test_outside_of_a_solve_a_switch_is_a_choice():
    found = fj.forces.switch(jnp.array([-1.0, 0, 1]), 5.0, 7.0)
    assert found.tolist() == [7, 7, 5]
    clipped = fj.forces.clip(jnp.array([-3.0, 0.5, 3]), -1, 2)
    assert clipped.tolist() == [-1, 0.5, 2]


def test_whether_efforts_jump_is_known_from_the_switches_met():
    jumping = []
    for met in (lambda: fj.forces.clip(1.0, 0, 2), lambda: fj.forces.switch(1.0, 0, 2)):
        switches = Switches(None)
        with switches.dealt():
            met()
        jumping.append(switches.jumping)
    assert jumping == [[False, False], [True]]


def test_switches_of_elements_traced_in_two_threads_stay_apart():
    def other():
        theirs.append(Switches(None))
        with theirs[0].dealt():
            inside.wait(60)  # until this thread's switch has been met, too
            fj.forces.switch(jnp.array(-2.0), 1, 0)
            inside.wait(60)

    theirs, inside, mine = [], threading.Barrier(2), Switches(None)
    with ThreadPoolExecutor(1) as pool, mine.dealt():
        done = pool.submit(other)
        inside.wait(60)
        fj.forces.switch(jnp.array(3.0), 1, 0)
        inside.wait(60)
        done.result()
    assert [*map(float, mine.values)] == [3] and [*map(float, theirs[0].values)] == [-2]


def test_kinks_of_high_gains_are_exact_in_derivatives():
    """A slide under a limited controller of 1e7 N/m for each kg switches five times."""
    slide = fj.Linkage(
        "P", length=[0, 1], com=[[0, 0]], mass=[0.1], inertia=[0.1], gravity=0.0
    )
    reference = lambda t, linkage: (jnp.ones(1), jnp.zeros(1))

    def end(speed, damping, tolerance):
        controller = fj.PDController(1e6, damping, 5.0, reference)
        motion = fj.simulate(
            slide, fj.State([0.9], jnp.stack([speed])), [0, 0.35], (controller,),
            rtol=tolerance, atol=tolerance,
        )  # fmt: skip
        return motion.q[-1, 0] + 0.1 * motion.qd[-1, 0], motion.stats["num_switches"]

    both = jax.jit(jax.value_and_grad(end, has_aux=True), **LOOPS)
    for damping in (60.0, 2.0):
        (_, switches), slope = both(2.0, damping, 1e-11)
        assert switches >= 5
        values = [both(2 + h, damping, 1e-13)[0][0] for h in (5e-5, 2.5e-5)]
        before = [both(2 - h, damping, 1e-13)[0][0] for h in (5e-5, 2.5e-5)]
        wide, near = (np.array(values) - before) / [1e-4, 5e-5]
        assert slope == pytest.approx((4 * near - wide) / 3, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("begin", [0.0, 0.1])
def test_a_limit_that_a_jump_exceeds_acts_at_once(begin):
    """A slide of 1 kg, at rest until then, is pushed by 5 N for 0.1 s."""
    slide = fj.Linkage(
        "P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[0.1], gravity=0.0
    )
    step = fj.references.Step(0.0, [1.0], begin=begin)
    for kp in (6.0, 100.0, 1e4, 1e6):  # from a limit that is soon left to a high gain
        controller = fj.PDController(kp, 0.0, 5.0, step)
        motion = fj.simulate(slide, fj.State([0], [0]), [0, begin + 0.1], (controller,))
        assert abs(motion.q[-1, 0] - 2.5 * 0.1**2) < 1e-12, kp


class Late(fj.Element):
    """Switches with a function that itself jumps, at a time that nothing declares."""

    low: fj.Values = fj.field((), unit="1")
    at: fj.Values = fj.field((), unit="s")

    def __call__(self, t, q, qd, linkage):
        side = jnp.where(t > self.at, 1.0, -self.low)
        return fj.forces.switch(side, 1.0, -1.0) * jnp.ones_like(q)


@pytest.mark.slow
@pytest.mark.parametrize("low", [0.5, 0.03, 1e-3, 1e-5])
def test_a_switching_function_may_jump(low):
    """A free slide is pushed back, and from the jump on forth."""
    slide = fj.Linkage(
        "P", length=[0, 1], com=[[0, 0]], mass=[1], inertia=[1], gravity=0.0
    )
    at, start = 0.77, fj.State([0.0], [0.0])
    motion = fj.simulate(slide, start, [0, 1.0], (Late(low, at),))
    assert motion.stats["num_switches"] == 1
    np.testing.assert_allclose(motion.qd[-1], [(1 - at) - at], atol=1e-12)
