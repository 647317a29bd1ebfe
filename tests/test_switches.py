"""Motions whose elements switch: where steps end, and derivatives through switches."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from elements import FORWARD, SLIDE
from helpers import Push
from modes import ADJOINT, LOOPS, hessian, jacobian
from switching_scenes import EACH, ELEMENTS, random_members, random_scene

import fdof_jax as fj
from fdof_jax.forces import switch
from fdof_jax.steps.looped_dopri8 import LoopedDopri8
from fdof_jax.steps.zeros import CHECKS, SHARES, passage

# Where steps end


@pytest.mark.slow
def test_zeros_of_cubic_polynomials():
    """Polynomials that pass zero, nearly meet it or stay away."""
    rng = np.random.default_rng(0)
    count, shares = 4000, np.append(SHARES, CHECKS)
    polynomials = [
        rng.choice([-1, 1]) * np.polynomial.Polynomial.fromroots(roots)
        for roots in rng.uniform(-3, 3, (count, 3))
    ]
    size = [np.abs(p(shares)).max() for p in polynomials]
    polynomials = [p + rng.uniform(-1, 1) * s for p, s in zip(polynomials, size)]
    rows = np.stack([p(shares) for p in polynomials], axis=1)[..., None]
    rows, checks = rows[: len(SHARES)], rows[len(SHARES) :]
    no, none, near = jnp.array([False]), jnp.zeros(1), jnp.array(1e-9)
    at = lambda a, b: passage(a, b, none + 1, no, none, near, no[0])
    found = jax.jit(jax.vmap(at, in_axes=1))
    first, crossed, _, hidden, switched, *_ = found(rows, checks)
    assert (hidden == 1).all()  # cubic polynomials are known exactly
    seen = 0
    for polynomial, share, crosses, ends, values in zip(
        polynomials, first, crossed, switched[:, 0], rows[..., 0].T
    ):
        falling = -polynomial.deriv()(1)
        assert ends == (falling > 0 and values[-1] <= 1e-9 * falling)
        zeros = polynomial.roots()
        zeros = np.sort(zeros[np.abs(zeros.imag) < 1e-12].real)
        slopes = polynomial.deriv()(zeros)
        falls = zeros[(zeros > 0) & (zeros < 1) & (slopes < 0)]
        if values[0] < 0:  # on the wrong side from the start on
            assert (share == 0) == (values[1] < 0)
            continue
        assert crosses == (falls.size > 0)
        if falls.size:
            assert abs(share - falls[0]) < 1e-9
            seen += 1
    assert 0.2 < seen / count < 0.8


class Wall(fj.Element):
    """A pull back to the start, and a stiff spring from 0.45 m on.

    The force hardly changes where the velocity passes a mark.
    """

    mark: fj.Values = fj.field((), unit="m/s")

    def __call__(self, t, q, qd, linkage):
        beyond = q - 0.45
        slower = switch(qd - self.mark, 0.0, 1e-9)
        return -10 + slower + switch(beyond, -1e5 * beyond, 0.0, continuous=True)


@pytest.mark.slow
def test_what_turns_back_just_before_or_beyond_its_zero_is_seen():
    """Without the wall, the slide would turn back at v^2/20, halfway through a step."""

    def throw(speed, mark=-9.0, tolerance=1e-9):
        options = dict(rtol=tolerance, atol=tolerance)
        start, wall = fj.State([0], [speed]), (Wall(mark),)
        return fj.simulate(SLIDE, start, [0, 0.5], wall, **options)

    for speed, switches in ((2.99, 0), (2.9999, 0), (3.0001, 2), (3.01, 2)):
        share = np.sqrt(abs(speed**2 / 20 - 0.45) / 0.45)
        for mark in (-9.0, 1.05 * 3 * share):  # passed shortly before, for a short step
            motion = throw(speed, mark)
            assert motion.stats["num_switches"] == switches + (mark > 0)
            assert abs(motion.stats["slowest_crossing"] / share - 1) < 2e-4
            assert ("nearly grazes" in repr(motion)) == (share < 0.01)
    assert throw(3.0).stats["slowest_crossing"] < 1e-4  # exact grazing
    free = throw(2.9)
    assert free.stats["slowest_crossing"] == np.inf and "switch" not in repr(free)
    # The motion does not depend on whether a step happens to end beyond the wall.
    near = throw(3.001).q[-1, 0] - throw(3.001, tolerance=1e-12).q[-1, 0]
    assert abs(near) < 1e-8


@pytest.mark.slow
def test_chatter_is_named_and_spoils_no_other_member():
    start, options = fj.State([-1.5], [0.5]), dict(throw=False, solver=LoopedDopri8())

    def motion(level):
        pushed = lambda t, q, qd, linkage: -switch(qd, level, -level)
        return fj.simulate(SLIDE, start, [0, 0.1], (pushed,), **options)

    found = jax.jit(jax.vmap(motion))(jnp.array([0.0, 100.0]))
    assert found.outcome.tolist() == ["successful", "too many switches"]
    assert jnp.isfinite(found.q[0]).all()


@pytest.mark.parametrize("transform", [jax.vmap, jax.jit])
def test_a_switch_that_the_integrator_cannot_see_is_refused(transform):
    friction = transform(lambda q, qd: -switch(q, 0.1, 2.0) * qd)
    force = lambda t, q, qd, linkage: friction(q, qd)
    with pytest.raises(ValueError, match=r"forces\[0\].switch: expected a call outs"):
        fj.simulate(SLIDE, fj.State([0], [1]), [0, 0.1], (force,))


# Derivatives


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [dict(solver=diffrax.Tsit5()), dict(adjoint=ADJOINT)],
    ids=["tangents, Tsit5", "adjoint"],
)
def test_switches_of_a_plain_function_are_located(options):
    """A slide at 1 m/s is braked beyond a level: both are in the function's closure."""

    def place(numbers):
        level, brake = numbers
        force = lambda t, q, qd, linkage: switch(q - level, -brake, 0.0)
        start = fj.State([0.0], [1.0])
        motion = fj.simulate(SLIDE, start, [0, 1.0], (force,), **options)
        return motion.q[-1, 0], motion.stats["num_switches"]

    slopes = jax.jit(jax.grad(place, has_aux=True), **LOOPS)
    found, switches = slopes(jnp.array([0.4, 0.5]))
    assert switches == 1
    np.testing.assert_allclose(found, [0.5 * 0.6, -(0.6**2) / 2], rtol=1e-10)


def test_kinks_of_high_gains_are_exact_in_derivatives():
    """A slide under a limited controller of 1e7 N/m for each kg switches five times."""
    slide, reference = SLIDE.replace(mass=[0.1]), fj.references.SetPoint([1.0])

    def end(speed, damping, tolerance):
        controller = fj.PDController(1e6, damping, 5.0, reference)
        scene = slide, fj.State([0.9], jnp.stack([speed])), [0, 0.35], (controller,)
        motion = fj.simulate(*scene, rtol=tolerance, atol=tolerance)
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
def test_gradients_of_random_motions_equal_differences():
    """In a size of the element, a mass and the start, in one direction."""

    def end(x, tolerance, member):
        scene = random_scene(x, x, 0.1 * (x - 1), member)
        options = dict(rtol=tolerance, atol=tolerance, throw=False) | FORWARD
        found = fj.simulate(scene, jnp.array([0, scene.t1]), **options)
        return found.q[-1], found.stats["num_switches"]

    members = jax.tree.map(lambda row: row[::EACH], random_members())

    @partial(jax.jit, **LOOPS)
    def slopes(x, tolerance):
        # One element after the other, as the steps that they need differ.
        each = len(members[0]) // len(ELEMENTS)

        def of_one(member):
            moved = partial(end, tolerance=tolerance, member=member)
            return jax.jvp(moved, (x,), (1.0,), has_aux=True)

        return jax.lax.map(of_one, members, batch_size=each)

    def differences(h):
        ends = lambda x: slopes(x, 1e-13)[0]
        slope = lambda h: (ends(1 + h) - ends(1 - h)) / (2 * h)
        return (4 * slope(h) - slope(2 * h)) / 3

    # The better of two: rounding weighs more in the closer one, and some motions have a
    # switch more or less within the wider one.
    exact = jnp.stack([differences(h) for h in (1e-4, 1e-5)])
    for tolerance, bound in ((1e-11, 1e-6), (1e-13, 1e-8)):
        _, found, switches = slopes(1.0, tolerance)
        error = jnp.linalg.norm(found[None] - exact, axis=-1).min(axis=0)
        assert (error / jnp.linalg.norm(found, axis=-1)).max() < bound
        assert (switches > 0).mean() > 0.5


# Derivatives where events coincide, or nearly


# A slide is pushed by 3 N from the time a on and by 5 N less from b on. Its last
# velocity and place from rest are closed forms of a, b, the first and the last time.


@jacobian
def slopes_in_times(x):
    start, pushes = fj.State([0.0], [0.3]), (Push(x[2], 3.0), Push(x[3], -5.0))
    found = fj.simulate(SLIDE, start, x[:2], pushes, **FORWARD)
    return found.q[-1, 0], found.qd[-1, 0], found.stats["num_rejected_steps"]


def pushed(t0, t1, a, b):
    """Returns the derivatives, one-sided where a or b is the first or the last time."""
    acts_a, acts_b = 3.0 * (t0 < a <= t1), -5.0 * (t0 < b <= t1)
    on = lambda t, force: force * (t1 - t) * (t <= t1)
    last = 3.0 * (a <= t1) - 5.0 * (b <= t1)
    first = 3.0 * (a <= t0) - 5.0 * (b <= t0)
    speed = 0.3 + on(max(a, t0), 3.0) + on(max(b, t0), -5.0)
    return [
        [-0.3 - first * (t1 - t0), speed, -on(a, acts_a), -on(b, acts_b)],
        [-first, last, -acts_a, -acts_b],
    ]


@pytest.mark.slow
@pytest.mark.parametrize("times", [
    (-1.0, 1.0, -0.3, 0.0), (-1.0, 1.0, 1e-12, -1e-12), (-1.0, 1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.3), (-1.0, 0.0, -1.0, 0.0), (0.3, 0.9, 0.1 + 0.2, 0.3 * 3),
    (0.3, 3.0, 0.4, 3.0 - 1e-14), (1e3, 1e3 + 1, 1e3, 1e3 + 1),
])  # fmt: skip
def test_derivatives_at_known_times_that_are_0_or_at_an_end(times):
    """A relative distance from a known time that is 0 is none: a step would end on it.

    Derivatives were wrong by 1 % of the jump, and a third of the steps were rejected.
    """
    (*slopes, _), (*_, rejected) = slopes_in_times(jnp.array(times))
    np.testing.assert_allclose(slopes, pushed(*times), atol=1e-9)
    assert rejected <= 3


class Marks(fj.Element):
    """Forces beyond two marks on the way of a slide."""

    places: fj.Values = fj.field((2,), unit="m")

    def __call__(self, t, q, qd, linkage):
        forces = switch(q - self.places, jnp.array([-3.0, -5.0]), 0.0)
        return jnp.sum(forces, keepdims=True)


@jax.jit
def both_ways(start, places):
    """Derivatives of the last position in the places, by both integrations."""
    ts, state = jnp.array([0.0, 0.8]), fj.State(jnp.array([start]), jnp.array([2.0]))

    scene_at = lambda places: fj.Scene(SLIDE, state, (Marks(places),), 0.8)

    def end(places):
        found = fj.simulate(scene_at(places), ts, **FORWARD)
        return found.q[-1, 0], found.stats

    last = lambda scene, solution: solution.q[-1]
    varied = fj.simulation.sensitivities(scene_at, last, places, ts, 1e-9)
    slope, stats = jax.jacfwd(end, has_aux=True)(places)
    return slope, varied.jacobian[0], stats["one_sided"]


@pytest.mark.slow
def test_each_of_coincident_switches_has_its_own_jump_and_is_said_to_coincide():
    """A mass of 1 kg at 2 m/s meets both marks at 0.5 s, or starts on one of them."""
    together = both_ways(0.0, jnp.array([1.0, 1.0]))
    for slope in together[:2]:
        np.testing.assert_allclose(slope, [0.45, 0.75], atol=1e-8)
    apart = both_ways(0.0, jnp.array([0.9, 1.0]))
    begun = both_ways(1.0, jnp.array([1.0, 1.5]))
    assert [int(found[2]) for found in (together, apart, begun)] == [1, 0, 1]


# Two sliders at right angles, which move independently, each as one of 1 kg.
SLIDERS = fj.Linkage(
    "PP", length=[0, 0, 1], com=[[0, 0]] * 2, mass=[1, 1], inertia=[0.1, 0.1],
    locked=[np.pi / 2, 0], gravity=0,
)  # fmt: skip
END = 1.4


class Springless(fj.Element):
    """Draws each slider to 0, by 3 or 5 N; from a known time on it pushes by 0.5 N."""

    begin: fj.Values = fj.field((), unit="s")

    def __call__(self, t, q, qd, linkage):
        push = jnp.where(t < self.begin, 0.0, 0.5)
        moved = jnp.array([2.0, 1.0])  # by each slider [kg]
        return moved * (switch(q, -3.0, 5.0) + push)

    @property
    def jump_ts(self):
        return jnp.reshape(self.begin, (1,))


def where_sliders_end(x):
    """Returns their places and speeds, if they pass 0 once, after the known time."""
    place, speed, begin = x[:2], x[2:4], x[4]
    place = place + speed * begin - 1.5 * begin**2
    speed = speed - 3 * begin
    passing = -jnp.sqrt(speed**2 + 5 * place)
    left = END - begin - (speed - passing) / 2.5
    return jnp.concatenate([passing * left + 2.75 * left**2, passing + 5.5 * left])


@pytest.fixture(scope="module")
def slopes_of_sliders():
    """Second and first derivatives, and values, of motions and of closed forms."""

    def end(x):
        start, forces = fj.State(x[:2], x[2:4]), (Springless(x[4]),)
        found = fj.simulate(SLIDERS, start, [0, END], forces, **FORWARD)
        return jnp.concatenate([found.q[-1], found.qd[-1]])

    return hessian(end), hessian(where_sliders_end)


@pytest.mark.slow
@pytest.mark.parametrize("apart", [1e-4, 1e-9, 1e-12])
@pytest.mark.parametrize("event", ["a switch", "a known time"])
def test_derivatives_of_both_orders_at_events_close_together(
    slopes_of_sliders, event, apart
):
    """In so short a step the slope of a switching function is lost in differences."""
    x = [1.0, 1.0, 0.2, 0.2 - 2 * apart, 0.4]  # the second passes 0 that much earlier
    if event == "a known time":
        x[3], x[4] = 0.3, (0.2 + np.sqrt(0.2**2 + 6)) / 3 - apart
    for slope, expected in zip(*(of(jnp.array(x)) for of in slopes_of_sliders)):
        size = np.abs(expected).max()
        np.testing.assert_allclose(slope, expected, atol=1e-8 * size)
