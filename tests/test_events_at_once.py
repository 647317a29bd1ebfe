"""Derivatives where several events coincide: known times, switches, and the start."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Push
from modes import LOOPS, hessian, jacobian

import fdof_jax as fj
from fdof_jax.steps.zeros import CHECKS, SHARES, passage

SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1], gravity=0
)
FORWARD = diffrax.ForwardMode()


class Marks(fj.Element):
    """Forces beyond two marks on the way of a slide."""

    places: fj.Values = fj.field((2,), unit="m")

    def __call__(self, t, q, qd, linkage):
        forces = fj.forces.switch(q - self.places, jnp.array([-3.0, -5.0]), 0.0)
        return jnp.sum(forces, keepdims=True)


# A slide is pushed by 3 N from the time a on and by 5 N less from b on. Its last
# velocity and place from rest are closed forms of a, b, the first and the last time.
KINDS = "forward", "adjoint", "beside the motion"


@pytest.fixture(scope="module")
def slopes_in_times():
    """Derivatives in (first, last, a, b), by each kind, and the rejected steps."""
    rest = fj.State(jnp.zeros(1), jnp.full(1, 0.3))
    pushes = lambda x: (Push(x[2], 3.0), Push(x[3], -5.0))
    adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=100)

    def end(x, adjoint):
        found = fj.simulate(SLIDE, rest, x[:2], pushes(x), adjoint=adjoint)
        return jnp.stack([found.q[-1, 0], found.qd[-1, 0]]), found.stats

    def beside(x):
        return fj.simulation.sensitivities(
            lambda x: fj.Scene(SLIDE, rest, pushes(x), 1.0),
            lambda scene, motion: jnp.stack([motion.q[-1, 0], motion.qd[-1, 0]]),
            x, x[:2], 1e-9,
        ).jacobian  # fmt: skip

    forward = jacobian(lambda x: end(x, FORWARD))
    reverse = jax.jit(jax.jacrev(lambda x: end(x, adjoint)[0]))
    varied = jax.jit(beside)

    def found(x):
        (slope, _), (_, stats) = forward(x)
        return (slope, reverse(x), varied(x)), int(stats["num_rejected_steps"])

    return found


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
    (-1.0, 1.0, 0.0, 0.3), (-1.0, 1.0, -0.3, 0.0), (-1.0, 1.0, 1e-12, -1e-12),
    (-1.0, 1.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.3), (0.0, 1.0, 0.4, 1.0),
    (-1.0, 0.0, -0.5, 0.0), (-1.0, 0.0, 0.0, 0.0), (-1.0, 0.0, -1.0, 0.0),
    (0.3, 0.9, 0.1 + 0.2, 0.3 * 3), (0.3, 3.0, 0.4, 3.0 - 1e-14),
    (1e3, 1e3 + 1, 1e3, 1e3 + 1), (0.0, 0.8, 0.5, 0.5),
])  # fmt: skip
def test_derivatives_at_known_times_that_are_0_or_at_an_end(slopes_in_times, times):
    """A relative distance from a known time that is 0 is none: a step would end on it.

    Derivatives were wrong by 1 % of the jump, and a third of the steps were rejected.
    """
    slopes, rejected = slopes_in_times(jnp.array(times))
    for slope, kind in zip(slopes, KINDS):
        known = slice(None) if kind != KINDS[2] else slice(2, None)  # its ts are fixed
        expected = np.array(pushed(*times))[:, known]
        np.testing.assert_allclose(slope[:, known], expected, atol=1e-9, err_msg=kind)
    assert rejected <= 3


def both_ways(start, places):
    """Derivatives of the last position in the places, by both integrations."""
    ts, state = jnp.array([0.0, 0.8]), fj.State(jnp.array([start]), jnp.array([2.0]))

    def end(places):
        found = fj.simulate(SLIDE, state, ts, (Marks(places),), adjoint=FORWARD)
        return found.q[-1, 0], found.stats

    varied = fj.simulation.sensitivities(
        lambda places: fj.Scene(SLIDE, state, (Marks(places),), 0.8),
        lambda scene, solution: solution.q[-1],
        places, ts, 1e-9,
    )  # fmt: skip
    slope, stats = jax.jacfwd(end, has_aux=True)(places)
    return slope, varied.jacobian[0], stats["one_sided"]


@pytest.mark.slow
def test_each_of_coincident_switches_has_its_own_jump_and_is_said_to_coincide():
    """A mass of 1 kg at 2 m/s meets both marks at 0.5 s, or starts on one of them."""
    slopes = jax.jit(both_ways)
    together = slopes(0.0, jnp.array([1.0, 1.0]))
    for slope in together[:2]:
        np.testing.assert_allclose(slope, [0.45, 0.75], atol=1e-8)
    apart = slopes(0.0, jnp.array([0.9, 1.0]))
    begun = slopes(1.0, jnp.array([1.0, 1.5]))
    assert [int(found[2]) for found in (together, apart, begun)] == [1, 0, 1]


# Two sliders at right angles, which move independently, each as one of 1 kg.
SLIDERS = fj.Linkage(
    "PP", length=[0, 0, 1], com=[[0, 0]] * 2, mass=[1, 1], inertia=[0.1, 0.1],
    locked=[np.pi / 2, 0], gravity=0,
)  # fmt: skip
END = 1.4


class Springless(fj.Element):
    """Draws each slider to 0, from above by 3 N and from below by 5 N.

    From a known time on it pushes by 0.5 N.
    """

    begin: fj.Values = fj.field((), unit="s")

    def __call__(self, t, q, qd, linkage):
        push = jnp.where(t < self.begin, 0.0, 0.5)
        moved = jnp.array([2.0, 1.0])  # by each slider [kg]
        return moved * (fj.forces.switch(q, -3.0, 5.0) + push)

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
    ts = jnp.array([0.0, END])
    ends = lambda motion: jnp.concatenate([motion.q[-1], motion.qd[-1]])
    scene = lambda x: fj.Scene(
        SLIDERS, fj.State(x[:2], x[2:4]), (Springless(x[4]),), END
    )

    def end(x):
        arm, start, forces, _ = scene(x)
        return ends(fj.simulate(arm, start, ts, forces, adjoint=FORWARD))

    return hessian(end), hessian(where_sliders_end)


@pytest.mark.slow
@pytest.mark.parametrize("apart", [1e-4, 1e-6, 1e-8, 1e-9, 1e-10, 1e-12])
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


class Wall(fj.Element):
    """A pull back to the start, and a stiff spring from 0.45 m on."""

    def __call__(self, t, q, qd, linkage):
        beyond = q - 0.45
        return -10 + fj.forces.switch(beyond, -1e5 * beyond, 0.0, continuous=True)


@pytest.mark.slow
@pytest.mark.parametrize("near", [np.inf, 6e3])  # no length, and 3e-16 s of 2e-12
def test_rounding_in_a_step_of_almost_no_length_is_no_switch(near):
    """Samples of one instant may differ by rounding, falling to the end."""
    falls = 1 - 1e-16 * np.arange(len(SHARES))
    margins = jnp.array([195.0 * falls, -1e-9 * falls, 3e-13 * falls]).T
    sides, begun, brief = jnp.ones(3), jnp.zeros(3, bool), jnp.array(True)
    before = jnp.array([300.0, 300.0, 1.0])
    *_, switched, grazing, soon, _ = passage(
        margins, margins[: len(CHECKS)], sides, begun, before, jnp.array(near), brief
    )
    assert switched.tolist() == [False, True, False]  # the second is past its zero
    assert grazing == soon == 0


@pytest.mark.slow
def test_what_turns_back_just_before_or_beyond_its_zero_is_seen():
    """Without the wall, the slide would turn back at v^2/20, halfway through a step."""

    def throw(speed, tolerance=1e-9):
        found = fj.simulate(
            SLIDE, fj.State([0], [speed]), [0, 0.8], (Wall(),), rtol=tolerance,
            atol=tolerance,
        )  # fmt: skip
        return found.q[-1, 0], int(found.stats["num_switches"]), found

    for speed, switches in ((2.99, 0), (2.9999, 0), (3.0001, 2), (3.01, 2)):
        _, count, motion = throw(speed)
        share = np.sqrt(abs(speed**2 / 20 - 0.45) / 0.45)
        assert count == switches
        assert abs(motion.stats["slowest_crossing"] / share - 1) < 1e-4
        assert ("switches: 2" in repr(motion)) == (count == 2)
        assert ("nearly grazes" in repr(motion)) == (share < 0.01)
    assert throw(3.0)[2].stats["slowest_crossing"] < 1e-4  # exact grazing
    free = throw(2.9)[2]
    assert free.stats["slowest_crossing"] == np.inf
    assert "switch" not in repr(free)
    # The motion does not depend on whether a step happens to end beyond the wall.
    assert abs(throw(3.001)[0] - throw(3.001, 1e-12)[0]) < 1e-8


@pytest.mark.slow
def test_what_a_blow_switches_at_once_switches_at_the_time_of_the_blow():
    """A ball is pushed by 1 N as it falls, and by -4 N as it rises."""

    def place(x, **options):
        q0, gravity, restitution = x
        ball = fj.Linkage(
            "P", length=[0, 0], com=[[0, 0]], mass=[1], inertia=[1], base_angle=0
        ).replace(gravity=gravity)
        stop = fj.forces.HardStops(0, jnp.inf, restitution=restitution)
        push = lambda t, q, qd, linkage: fj.forces.switch(qd, -4 + 0 * q, 1 + 0 * q)
        start = fj.State(q0[None], jnp.zeros(1))
        return fj.simulate(ball, start, [0, 0.7], (stop, push), **options).q[-1, 0]

    def exactly(x):
        q0, gravity, restitution = x
        fall = jnp.sqrt(2 * q0 / (gravity - 1))
        speed, rest = restitution * (gravity - 1) * fall, 0.7 - fall
        return speed * rest - (gravity + 4) * rest**2 / 2

    x = jnp.array([1.0, 9.81, 0.9])  # it still rises at the end
    curves, forward, _ = hessian(lambda x: place(x, adjoint=FORWARD))(x)
    reverse = jax.jit(jax.grad(place), **LOOPS)(x)
    for slopes in (forward, reverse):
        np.testing.assert_allclose(slopes, jax.grad(exactly)(x), atol=1e-9)
    np.testing.assert_allclose(curves, jax.hessian(exactly)(x), atol=1e-7)


@pytest.mark.parametrize("transform", [jax.vmap, jax.jit])
def test_a_switch_that_the_integrator_cannot_see_is_refused(transform):
    friction = transform(lambda q, qd: -fj.forces.switch(q, 0.1, 2.0) * qd)
    force = lambda t, q, qd, linkage: friction(q, qd)
    with pytest.raises(
        ValueError, match=r"forces\[0\].switch: expected a call outside"
    ):
        fj.simulate(SLIDE, fj.State([0], [1]), [0, 0.1], (force,))


@pytest.mark.slow
def test_zeros_of_cubic_polynomials():
    """Polynomials that pass zero, nearly meet it or stay away."""
    rng = np.random.default_rng(0)
    count = 4000
    shares = np.append(SHARES, CHECKS)
    polynomials = [
        rng.choice([-1, 1]) * np.polynomial.Polynomial.fromroots(roots)
        for roots in rng.uniform(-3, 3, (count, 3))
    ]
    size = [np.abs(p(shares)).max() for p in polynomials]
    polynomials = [p + rng.uniform(-1, 1) * s for p, s in zip(polynomials, size)]
    rows = np.stack([p(shares) for p in polynomials], axis=1)[..., None]
    rows, checks = rows[: len(SHARES)], rows[len(SHARES) :]
    no, none, near = jnp.array([False]), jnp.zeros(1), jnp.array(1e-9)
    side = none + 1
    found = jax.jit(
        jax.vmap(lambda a, b: passage(a, b, side, no, none, near, no[0]), in_axes=1)
    )
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
