"""Derivatives where several events coincide: known times, switches, and the start."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fdof_jax as fj
from fdof_jax.simulation.sensitivities import sensitivities
from fdof_jax.simulation.zeros_in_steps import SHARES, at_end, first_zero, passage

SLIDE = fj.Linkage(
    "P", length=[0, 1], com=[[0.5, 0]], mass=[1], inertia=[0.1], gravity=0
)
FORWARD = diffrax.ForwardMode()


class Push(fj.Element):
    """A force from a time on that it declares."""

    begin: fj.Values = fj.field((), unit="s")
    force: fj.Values = fj.field((), unit="N")

    def __call__(self, t, q, qd, linkage):
        return jnp.where(t >= self.begin, self.force, 0.0) * jnp.ones_like(q)

    @property
    def jump_ts(self):
        return jnp.reshape(self.begin, (1,))


def test_each_of_coincident_known_times_has_the_jump_of_its_element():
    """A mass of 1 kg is pushed from two times on that are both 0.5 s."""
    start, ts = fj.State(jnp.zeros(1), jnp.zeros(1)), jnp.array([0.0, 0.8])
    pushes = lambda begins: (Push(begins[0], 3.0), Push(begins[1], 5.0))
    end = lambda begins: fj.simulate(
        SLIDE, start, ts, pushes(begins), adjoint=FORWARD
    ).q[-1, 0]
    varied = lambda begins: sensitivities(
        lambda begins: fj.Scene(SLIDE, start, pushes(begins), 0.8),
        lambda scene, solution: solution.q[-1],
        begins, ts, 1e-9,
    ).jacobian[0]  # fmt: skip
    once = jnp.array([0.5, 0.5])
    for slope in (jax.jacfwd(end), varied):
        np.testing.assert_allclose(jax.jit(slope)(once), [-0.9, -1.5], atol=1e-9)


class Marks(fj.Element):
    """Forces beyond two marks on the way of a slide."""

    places: fj.Values = fj.field((2,), unit="m")

    def __call__(self, t, q, qd, linkage):
        forces = fj.forces.switch(q - self.places, jnp.array([-3.0, -5.0]), 0.0)
        return jnp.sum(forces, keepdims=True)


def both_ways(start, places):
    """Derivatives of the last position in the places, by both integrations."""
    ts, state = jnp.array([0.0, 0.8]), fj.State(jnp.array([start]), jnp.array([2.0]))

    def end(places):
        found = fj.simulate(SLIDE, state, ts, (Marks(places),), adjoint=FORWARD)
        return found.q[-1, 0], found.stats

    varied = sensitivities(
        lambda places: fj.Scene(SLIDE, state, (Marks(places),), 0.8),
        lambda scene, solution: solution.q[-1],
        places, ts, 1e-9,
    )  # fmt: skip
    slope, stats = jax.jacfwd(end, has_aux=True)(places)
    return slope, varied.jacobian[0], stats["one_sided"]


def test_each_of_coincident_switches_has_its_own_jump_and_is_said_to_coincide():
    """A mass of 1 kg at 2 m/s meets both marks at 0.5 s, or starts on one of them."""
    slopes = jax.jit(both_ways)
    together = slopes(0.0, jnp.array([1.0, 1.0]))
    for slope in together[:2]:
        np.testing.assert_allclose(slope, [0.45, 0.75], atol=1e-8)
    apart = slopes(0.0, jnp.array([0.9, 1.0]))
    begun = slopes(1.0, jnp.array([1.0, 1.5]))
    assert [int(found[2]) for found in (together, apart, begun)] == [1, 0, 1]


class Wall(fj.Element):
    """A pull back to the start, and a stiff spring from 0.45 m on."""

    def __call__(self, t, q, qd, linkage):
        beyond = q - 0.45
        return -10 + fj.forces.switch(beyond, -1e5 * beyond, 0.0, continuous=True)


def test_rounding_in_a_step_of_no_length_is_no_switch():
    """Samples of one instant may differ by rounding, falling to the end."""
    falls = 1 - 1e-16 * np.arange(len(SHARES))
    margins = jnp.array([195.0 * falls, -1e-9 * falls]).T
    switched, grazing, soon = at_end(margins, jnp.array([300.0, 300.0]), jnp.inf)
    assert switched.tolist() == [False, True]  # the second is past its zero
    assert grazing == soon == 0


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


@pytest.mark.parametrize("transform", [jax.vmap, jax.jit])
def test_a_switch_that_the_integrator_cannot_see_is_refused(transform):
    friction = transform(lambda q, qd: -fj.forces.switch(q, 0.1, 2.0) * qd)
    force = lambda t, q, qd, linkage: friction(q, qd)
    with pytest.raises(
        ValueError, match=r"forces\[0\].switch: expected a call outside"
    ):
        fj.simulate(SLIDE, fj.State([0], [1]), [0, 0.1], (force,))


def test_far_from_zero_nothing_is_searched_and_nothing_missed():
    """Polynomials that pass zero, nearly meet it or stay away, in all step lengths."""
    rng = np.random.default_rng(0)
    shares = np.asarray(SHARES)
    roots = rng.uniform(-3, 3, (4000, 3))
    rows = np.prod(shares[:, None] - roots.T[:, None], axis=0) * rng.choice(
        [-1, 1], 4000
    )
    rows = rows + rng.uniform(-1, 1, 4000) * np.abs(rows).max(axis=0)
    near = 10.0 ** rng.uniform(-10, 1, 4000)
    before = np.abs(rows).max(axis=0) * rng.uniform(0, 3, 4000)
    sizes = np.maximum(before, np.abs(rows).max(axis=0))
    one = lambda *a: passage(a[0][:, None], a[1][None], a[2][None], a[3])
    every = jax.jit(jax.vmap(one, (1, 0, 0, 0)))
    found = every(rows, before, sizes, near)

    def slow(margins, before, sizes, near):
        margins, before, sizes = margins[:, None], before[None], sizes[None]
        return *first_zero(margins, before), *at_end(margins, sizes, near)

    expected = jax.jit(jax.vmap(slow, (1, 0, 0, 0)))(rows, before, sizes, near)
    for a, b in zip(found, expected):
        np.testing.assert_array_equal(a, b)
    quiet = ~np.asarray(expected[1]) & ~np.asarray(expected[3])[:, 0]
    assert 0.2 < quiet.mean() < 0.8
